"""Damaged logs: what is whole is read and said to be a part; the rest is refused, and never read as a whole."""

import re
import time
import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.tiers import slow
from tests.views.runs import about, make_run, steps_of


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    text, empty, folder = tmp_path / "notes.rrd", tmp_path / "empty.rrd", tmp_path / "folder.rrd"
    text.write_text("these are notes")
    empty.touch()
    folder.mkdir()
    for path in (text, empty):
        with pytest.raises(
            km.errors.LogError, match=rf"{path.name} is not a log of koopmpc: it does not start as an \.rrd file does"
        ):
            km.load_run(path)
    text.write_bytes(b"RRF2")  # what stands before a cut is read from a copy, which no message names
    with pytest.raises(km.errors.LogError, match=rf"RRD file at {re.escape(str(text))}: "):
        km.load_run(text)
    with pytest.raises(km.errors.LogError, match=r"folder\.rrd is a folder; pass the \.rrd of a run"):
        km.load_run(folder)
    with pytest.raises(km.errors.LogError, match=r"nowhere\.rrd does not exist; pass the \.rrd of a run"):
        km.load_run(tmp_path / "nowhere.rrd")


def test_a_recording_of_something_else_is_refused(tmp_path: Path) -> None:
    import rerun as rr

    other = rr.RecordingStream("something_else")
    other.save(tmp_path / "other.rrd")
    other.log("state", rr.Scalars([1.0]))
    other.flush()
    other.disconnect()
    with pytest.raises(km.errors.LogError, match=r"other\.rrd is a Rerun recording, but no log of koopmpc: it has no"):
        km.load_run(tmp_path / "other.rrd")


def test_a_log_without_a_whole_step_is_refused(tmp_path: Path) -> None:
    run = make_run()
    with km.Recorder(tmp_path / "none.rrd", **about(run)):
        pass
    with km.Recorder(tmp_path / "half.rrd", **about(run)) as recorder:
        recorder(steps_of(run)[0].__class__(0, run.Y[0], run.U[0], run.reference[0]))
    for name in ("none", "half"):
        with pytest.raises(
            km.errors.LogError, match=rf"{name}\.rrd holds no whole step; its run ended before the second state"
        ):
            km.load_run(tmp_path / f"{name}.rrd")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 60 steps, written as it happens in three batches."""
    path = tmp_path_factory.mktemp("logs") / "run.rrd"
    run = make_run(T=60)
    with km.Recorder(path, **about(run)) as recorder:
        for step in steps_of(run):
            recorder(step)
            end = time.monotonic() + 60
            while step.k in (19, 39) and count_flushed(path) < step.k - 1 and time.monotonic() < end:
                time.sleep(0.1)  # until the batch is written; a step is held back for what follows it
    return path


def count_flushed(path: Path) -> int:
    read, _ = outcome(path)
    return 0 if read is None else read.steps


@pytest.mark.parametrize("share", [0.1, *slow([0.9])])
def test_a_log_cut_before_its_description_is_refused(written: Path, tmp_path: Path, share: float) -> None:
    whole = written.read_bytes()
    (tmp_path / "cut.rrd").write_bytes(whole[: int(share * whole.find(b"koopmpc-log-2"))])
    with pytest.raises(km.errors.LogError, match=r"cut\.rrd .*(No recording|or was cut before it)"):
        km.load_run(tmp_path / "cut.rrd")


@pytest.mark.parametrize("share", [0.0, 0.999, 1.0, *slow([0.2, 0.4, 0.7])])
def test_a_log_cut_behind_its_first_batch_is_read_up_to_the_cut(written: Path, tmp_path: Path, share: float) -> None:
    path, whole = tmp_path / "cut.rrd", written.read_bytes()
    run = make_run(T=60)
    start = whole.find(run.plans.X[25].tobytes())  # the plans come first in a batch: the first batch is whole
    assert start > 0
    path.write_bytes(whole[: int(start + share * (len(whole) - start))])
    read, said = outcome(path)
    assert read is not None
    assert read == head(run, read.steps)
    if share == 1.0:
        assert said == []
    elif said != [word(path, 60, 60, planned="")]:  # a Recorder does not know beforehand how many there will be
        assert said == [word(path, read.steps, 1000, planned="")]


def head(run: km.Run, steps: int) -> km.Run:
    """Return the first steps of a run."""
    ends = ("X", "Y", "reference")
    moves = ("U", "u_reference", *(field.name for field in fields(km.Run) if "move" in field.metadata))
    return replace(
        run,
        **{name: getattr(run, name)[: steps + 1] for name in ends},
        **{name: getattr(run, name)[:steps] for name in moves},
        plans=km.loop.Plans(run.plans.X[:steps], run.plans.U[:steps]),
    )


def word(path: Path, steps: int, total: int, planned: str) -> str:
    """Return what is said about a part of a log; `planned` where its length is known beforehand."""
    if steps == total:
        return f"{path}: its end is cut, all {steps} steps are there"
    return (
        f"{path} ends after step {steps}{planned}: the file was cut short or its writer did not close it; "
        "the run holds what is there"
    )


def outcome(path: Path) -> tuple[km.Run | None, list[str]]:
    """Return what is read and the words that are said; no run where it is refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            read = km.load_run(path)
        except km.errors.LogError as error:
            return None, [str(error)]
    return read, [str(w.message) for w in caught]


def test_a_recorded_log_cut_anywhere_is_read_up_to_the_cut(tmp_path: Path) -> None:
    """However `record` was cut: refused before the first block, then block by block, never as a whole run."""
    run, whole, path = make_run(T=450), tmp_path / "run.rrd", tmp_path / "cut.rrd"
    km.record(run, whole)
    data = whole.read_bytes()
    found = []
    for share in (*np.linspace(0.1, 1.0, 6, endpoint=False), 1 - 1 / len(data)):
        path.write_bytes(data[: int(share * len(data))])
        read, said = outcome(path)
        steps = 0 if read is None else read.steps
        if read is None:
            assert str(path) in said[0]
        else:
            assert read == head(run, steps)
            assert said == [word(path, steps, 450, planned=" of 450")]
        found.append(steps)
    assert found == sorted(found)
    assert len(set(found)) == 5  # none, three parts, all
    assert found[-1] == 450


@pytest.mark.parametrize("count", [4, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("grown", [*slow([False]), True], ids=["record", "Recorder"])
def test_a_log_cut_at_a_random_byte_is_read_and_repaired_or_refused(
    written: Path, tmp_path: Path, grown: bool, count: int
) -> None:
    """Half of the thousand are logs of `record`, half grew while their loop ran."""
    run, path, repaired = make_run(T=60), tmp_path / "cut.rrd", tmp_path / "cut.repaired.rrd"
    if not grown:
        km.record(run, path)
    data, read = (written if grown else path).read_bytes(), 0
    for end in np.random.default_rng(0).integers(0, len(data), (count + 1) // 2).tolist():
        path.write_bytes(data[:end])
        repaired.unlink(missing_ok=True)
        (found,) = km.bench.inspect_logs([path], repair=True)
        if found.refused is not None:
            assert str(path) in found.refused
            assert not repaired.exists()
            continue
        read += 1
        assert found.cut is not None
        again = km.load_run(repaired)
        assert again == head(run, again.steps)
    assert 0 < read < count


def test_a_recorded_log_says_what_it_was_however_little_is_left(tmp_path: Path) -> None:
    km.record(make_run(T=200), tmp_path / "run.rrd")
    data = (tmp_path / "run.rrd").read_bytes()
    (tmp_path / "cut.rrd").write_bytes(data[: len(data) // 10])
    with pytest.raises(km.errors.LogError, match=r"cut\.rrd holds no whole step; its run ended before"):
        km.load_run(tmp_path / "cut.rrd")


def test_a_log_cut_in_a_batch_ends_with_the_batch_before(written: Path, tmp_path: Path) -> None:
    """The bytes of the states of the last batch are lost; the log says that it is a part."""
    run, whole = make_run(T=60), written.read_bytes()
    place = whole.rfind(run.X[50].tobytes())
    assert place > 0
    (tmp_path / "cut.rrd").write_bytes(whole[:place])
    with pytest.warns(UserWarning, match=r"cut\.rrd ends after step \d+: "):
        read = km.load_run(tmp_path / "cut.rrd")
    assert 0 < read.steps < 50


@pytest.mark.parametrize("column", ["X", "U", "solve_time"])
def test_a_changed_number_is_not_read_as_the_run(tmp_path: Path, column: str) -> None:
    run, path = make_run(T=60), tmp_path / "run.rrd"
    km.record(run, path)
    whole, number = path.read_bytes(), np.ascontiguousarray(getattr(run, column)[30]).tobytes()[:8]
    if number not in whole:
        pytest.skip("the numbers were written compressed")
    for place in (match.start() for match in re.finditer(re.escape(number), whole)):
        path.write_bytes(whole[: place + 3] + bytes([whole[place + 3] ^ 1]) + whole[place + 4 :])
        with pytest.raises(km.errors.LogError, match=r"run\.rrd is damaged: it no longer holds what was written"):
            km.load_run(path)


def rewrite(log: Path, path: Path, seed: int | None = None, longer: int = 0) -> None:
    """Write the columns of a log anew without its checksum, in another order, and with further rows of a reference."""
    import rerun as rr
    from rerun.chunk import RrdReader

    chunks = [chunk for chunk in RrdReader(log).stream().to_chunks() if chunk.entity_path != "/checksum"]
    order = range(len(chunks)) if seed is None else np.random.default_rng(seed).permutation(len(chunks))
    written = rr.RecordingStream("again")
    written.save(path)
    for i in order:
        written.send_chunks([chunks[i]])
    if longer:
        written.set_time("step", sequence=1000)
        written.log("reference", rr.Scalars(np.zeros(longer)))
    written.disconnect()


@pytest.mark.parametrize("seed", range(6))
def test_rows_come_in_order_of_their_steps_whatever_that_of_their_batches(seed: int, tmp_path: Path) -> None:
    """A log without its checksum was not closed, and says so though all steps are there."""
    run, path = make_run(T=450), tmp_path / "again.rrd"
    km.record(run, tmp_path / "run.rrd")
    rewrite(tmp_path / "run.rrd", path, seed)
    read, said = outcome(path)
    assert read == run
    assert said == [word(path, 450, 450, planned=" of 450")]


def test_a_log_of_another_format_is_refused(tmp_path: Path) -> None:
    import rerun as rr

    other = rr.RecordingStream("other")
    other.save(path := tmp_path / "new.rrd")
    other.log("description", rr.AnyValues(json='{"format": "koopmpc-log-9"}'), static=True)
    other.disconnect()
    told = "the description has format 'koopmpc-log-9', this koopmpc reads 'koopmpc-log-2'"
    with pytest.raises(km.errors.LogError, match=told):
        km.load_run(path)


def test_a_log_whose_rows_differ_in_length_is_refused_by_its_name(tmp_path: Path) -> None:
    run, path = make_run(), tmp_path / "run.rrd"
    km.record(run, tmp_path / "whole.rrd")
    rewrite(tmp_path / "whole.rrd", path, longer=run.reference.shape[1] + 1)
    with pytest.raises(km.errors.LogError, match=r"run\.rrd is damaged: reference has rows of different lengths"):
        km.load_run(path)
