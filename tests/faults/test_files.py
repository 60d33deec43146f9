"""Saves are whole or not there: full disks, interrupts and flipped bits lose no file and change none in silence."""

import gc
import io
import random
import signal
import struct
import sys
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from koopmpc.base import disk
from tests.faults.damage import FORMATS, PLAIN, READERS, WRITERS, damaged, episodes, model, recorded, room_for, store
from tests.tiers import few
from tests.views.runs import make_run

UNCHANGED = b"what was there before"


def left(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", few(WRITERS, *(name for name in WRITERS if name not in ("figure.png", "figure.pdf"))))
@pytest.mark.parametrize("count", [2, pytest.param(30, marks=pytest.mark.slow)])
def test_a_full_disk_leaves_the_old_file_and_one_sentence(tmp_path: Path, name: str, count: int) -> None:
    WRITERS[name](tmp_path / name)
    size, rng = (tmp_path / name).stat().st_size, random.Random(name)
    (tmp_path / name).write_bytes(UNCHANGED)
    for _ in range(count):
        with room_for(rng.randrange(size * 99 // 100)), pytest.raises(km.errors.FullDiskError) as caught:
            WRITERS[name](tmp_path / name)
        said = str(caught.value)
        assert said.startswith(f"{tmp_path / name} cannot be written: File too large; the file that was there is as it")
        assert "\n" not in said
        assert (tmp_path / name).read_bytes() == UNCHANGED
        assert left(tmp_path) == [name]
    (tmp_path / name).unlink()
    with room_for(size // 2), pytest.raises(km.errors.FullDiskError, match="too large; make room, or pass another"):
        WRITERS[name](tmp_path / name)
    assert left(tmp_path) == []


def test_a_log_that_grows_is_kept_as_far_as_the_disk_took_it(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    recorded(path)
    whole = path.read_bytes()
    with room_for(len(whole) * 3 // 4), pytest.warns(UserWarning, match="run.rrd is not complete: .* File too large"):
        recorded(path)
    assert path.read_bytes() == whole  # a run that was recorded before is as it was
    assert left(tmp_path) == ["run.rrd", "run.rrd.part"]
    assert 0 < (tmp_path / "run.rrd.part").stat().st_size <= len(whole) * 3 // 4


@pytest.mark.parametrize("name", WRITERS)
def test_an_interrupt_in_a_save_leaves_the_old_file(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / name).write_bytes(UNCHANGED)

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(disk, "settle", interrupted)
    with pytest.raises(KeyboardInterrupt):
        WRITERS[name](tmp_path / name)
    assert (tmp_path / name).read_bytes() == UNCHANGED
    assert left(tmp_path) == [name]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of the zip that numpy had open
def test_an_interrupt_that_numpy_turns_into_an_error_of_its_zip_is_still_one(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    model(1).save(path)
    before = path.read_bytes()

    def interrupt(frame, event, _):
        if event == "return" and frame.f_code.co_name == "_open_to_write":
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)

    heard = signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            model(2).save(path)
    finally:
        sys.setprofile(None)
        signal.signal(signal.SIGINT, heard)
    gc.collect()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_save_keeps_links_permissions_and_read_only_files(tmp_path: Path) -> None:
    file, link = tmp_path / "data.csv", tmp_path / "link.csv"
    file.write_bytes(UNCHANGED)
    file.chmod(0o640)
    link.symlink_to(file)
    episodes().save(link)
    assert link.is_symlink()
    assert file.stat().st_mode & 0o777 == 0o640
    assert km.load_episodes(file) == episodes()
    with disk.writing("/dev/null") as stream:
        stream.write(b"x")
    assert Path("/dev/null").is_char_device()


def test_a_link_to_a_log_of_another_name_stays_a_link_and_the_log_is_read_by_both_names(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    log, link = tmp_path / "runs" / "monday.rrd", tmp_path / "last.rrd"
    link.symlink_to(log)  # at first to a log that is not there yet
    for seed in (0, 1):
        run = make_run(T=20, seed=seed)
        km.record(run, link)
        assert link.is_symlink()
        assert km.load_run(log) == km.load_run(link) == run
    before = log.read_bytes()
    with room_for(2000), pytest.raises(km.errors.FullDiskError, match=r"monday\.rrd cannot be written"):
        km.record(run, link)
    assert log.read_bytes() == before
    assert left(tmp_path) == ["last.rrd", "runs"]
    assert left(tmp_path / "runs") == ["monday.rrd"]
    with pytest.raises(km.errors.DataError, match="is given twice"):
        km.data.Files([log, link])


def flipped(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with one bit changed."""
    bad, bit = bytearray(data), rng.randrange(8 * len(data))
    bad[bit // 8] ^= 1 << bit % 8
    return bytes(bad)


@pytest.mark.parametrize("name", few(READERS, *(name for name in READERS if name != "run.rrd")))
@pytest.mark.parametrize("count", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_no_flipped_bit_is_read_as_other_data(tmp_path: Path, name: str, count: int) -> None:
    written, read = READERS[name][0](), READERS[name][1]
    path, bad = tmp_path / name, tmp_path / f"bad {name}"
    (WRITERS | {"sweep.sqlite": store})[name](path)
    data, rng, refused = path.read_bytes(), random.Random(count), 0
    for _ in range(count):
        bad.write_bytes(flipped(data, rng))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            said = ""
            try:
                found = read(bad)
            except km.errors.LogError as error:
                said, found = str(error), None
        refused += found is None or bool(caught)
        if found is None:
            assert str(bad) in said
        elif name == "sweep.sqlite":  # a line that is damaged is told, and the others are read
            assert [row for row in written if row in found] == found
            assert len(found) == len(written) or str(bad) in str(caught[0].message)
        else:
            assert found == written or caught
    assert refused > 0


@pytest.mark.parametrize("name", few(FORMATS, "pid.npz", "columns.dat", "problem.py"))
@pytest.mark.parametrize("count", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_damage_of_any_kind_ends_in_an_error_of_ours_or_in_data(tmp_path: Path, name: str, count: int) -> None:
    write, read = FORMATS[name]
    path, bad = tmp_path / name, tmp_path / "bad" / name
    bad.parent.mkdir()
    write(path)
    data, rng, refused = path.read_bytes(), random.Random(f"{name} {count}"), 0
    bad.write_bytes(data)
    whole = read(bad)
    for _ in range(count):
        bad.write_bytes(damaged(data, rng))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                assert read(bad) == whole or caught or name in PLAIN
            except km.KoopmpcError:
                refused += 1
    assert refused or name == "code.so"  # code is built again


def test_every_page_of_a_parquet_file_has_a_checksum(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    episodes(steps=2000).save(tmp_path / "data.parquet")
    data = bytearray((tmp_path / "data.parquet").read_bytes())
    held = pq.ParquetFile(tmp_path / "data.parquet").metadata.row_group(0).column(3)
    data[held.data_page_offset + held.total_compressed_size - 5] ^= 4
    (tmp_path / "data.parquet").write_bytes(data)
    with pytest.raises(OSError, match="CRC"):
        pq.read_table(tmp_path / "data.parquet", page_checksum_verification=True)
    with pytest.raises(km.errors.LogError, match="columns are damaged"):
        km.load_episodes(tmp_path / "data.parquet")


def test_a_column_whose_name_is_no_text_any_more_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "data.parquet"
    episodes().save(path)
    path.write_bytes(path.read_bytes().replace(b"x [m]", b"\xed [m]"))
    with pytest.raises(km.errors.LogError, match=r"data\.parquet holds no episodes that can be read"):
        km.load_episodes(path)


def rezipped(path: Path, **members: bytes) -> None:
    """Write the members into the .npz file, instead of its own or beside them."""
    with zipfile.ZipFile(path) as held:
        kept = {info.filename: held.read(info) for info in held.infolist()}
    kept |= {f"{name}.npy": data for name, data in members.items()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        for name, data in kept.items():
            made.writestr(name, data)


def header(shape: tuple[int, ...]) -> bytes:
    """Return the head of a .npy file of this shape."""
    from io import BytesIO

    stream = BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return stream.getvalue()


def test_a_claimed_size_is_checked_before_it_is_allocated(tmp_path: Path) -> None:
    path = tmp_path / "data.npz"
    episodes().save(path)
    rezipped(path, X=header((10**12, 3)) + bytes(24))
    with pytest.raises(km.errors.LogError, match="it is damaged, or holds something other than arrays of numbers"):
        km.load_episodes(path)


def test_what_does_not_fit_into_memory_is_refused_with_the_number(tmp_path: Path, monkeypatch) -> None:
    episodes().save(tmp_path / "data.npz")
    episodes().save(tmp_path / "data.parquet")
    monkeypatch.setattr(disk, "memory", lambda: 1000)
    for name in ("data.npz", "data.parquet"):
        with pytest.raises(km.errors.LogError, match=r"would take .* GB, and 1e-06 GB are free"):
            km.load_episodes(tmp_path / name)


def test_members_that_nobody_needs_are_not_read(tmp_path: Path) -> None:
    import tracemalloc

    path = tmp_path / "model.npz"
    model().save(path)
    rezipped(path, array99=header((25_000_000,)) + bytes(200_000_000))
    assert path.stat().st_size < 1_000_000
    tracemalloc.start()
    assert km.load_model(path) == model()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("depth", [50, 5_000, 200_000])
@pytest.mark.parametrize("kind", ["list", "object", "sum"])
def test_nested_text_in_a_model_is_refused(tmp_path: Path, depth: int, kind: str) -> None:
    """Neither its reader nor what is built of it runs out of stack."""

    left, right = {"list": ("[", "]"), "object": ('{"a":', "}"), "sum": ('{"kind": "Sum", "parts": [', "]}")}[kind]
    path, member = tmp_path / "model.npz", io.BytesIO()
    model().save(path)
    text = f'{{"format": "koopmpc-1", "value": {left * depth}1{right * depth}}}'
    with np.load(path) as held:
        written = held["tree"].tobytes().decode()
    format_of = written.split('"format":')[1].split('"')[1]
    np.save(member, np.frombuffer(text.replace("koopmpc-1", format_of).encode(), dtype=np.uint8))
    rezipped(path, tree=member.getvalue())
    with pytest.raises(km.errors.LogError, match=r"model\.npz"):
        km.load_model(path)


@pytest.mark.parametrize("before", [0, 1, 3])
def test_free_space_of_no_length_at_the_very_end_of_a_heap_of_texts_is_refused(tmp_path: Path, before: int) -> None:
    def make_heap(last: int) -> bytes:
        words = b"".join(struct.pack("<HHIQ", 7, 1, 0, 5) + b"words\0\0\0" for _ in range(before))
        content = words + struct.pack("<HHIQ", 0, 0, 0, last)
        return b"GCOL\1\0\0\0" + struct.pack("<Q", 16 + len(content)) + content

    for last in (0, 16):
        (tmp_path / "heap.h5").write_bytes(b"\x89HDF" + make_heap(last) + bytes(40))
        with pytest.raises(km.errors.LogError) as error:  # it is no whole HDF5 file, either
            km.load_episodes(tmp_path / "heap.h5")
        assert ("a heap of texts is damaged" in str(error.value)) == (last == 0)
