"""Logs of other tools: each is written by its own library and read back as the rows that were written."""

import gc
import json
import sqlite3
import struct
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.data.files import recording
from koopmpc.data.files.columns import TableSettings

DT = 0.01
T = DT * np.arange(400)
THETA, OMEGA, TORQUE = np.sin(2 * T), 2 * np.cos(2 * T), np.sign(np.sin(7 * T))
JOINTS = "sensor_msgs/msg/JointState"


def write_mat(path, **more):
    from scipy.io import savemat

    savemat(path, {"t": T, "theta": THETA, "omega": OMEGA, "u": TORQUE} | more, do_compression=True)


def write_mat73(path):
    import h5py

    with h5py.File(path, "w", userblock_size=512) as stream:
        for name, values in (("t", T), ("theta", THETA), ("omega", OMEGA), ("u", TORQUE)):
            stream[name] = values[None]  # MATLAB's column vector
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<HH", 0x200, 0x4D49))


def write_h5(path):
    import h5py

    with h5py.File(path, "w") as stream:
        group = stream.create_group("motor")
        for name, values, unit in (("theta", THETA, "rad"), ("omega", OMEGA, "rad/s"), ("u", TORQUE, "N m")):
            group[name] = values
            group[name].attrs["units"] = unit
        stream.attrs["dt"] = DT


def write_mdf(path, slow=None, start=0.0):
    from asammdf import MDF, Signal

    with MDF(version="4.10") as mdf:
        mdf.append([Signal(THETA, T + start, name="theta", unit="rad"), Signal(OMEGA, T + start, name="omega")])
        every = slow or 1
        mdf.append([Signal(TORQUE[::every], T[::every] + start, name="u", unit="N m")])
        mdf.save(path, overwrite=True)


def messages():
    """Yield topic, time [ns] and content of a loop's messages, in the order of time."""
    for k, t in enumerate(np.round(T * 1e9).astype(int).tolist()):
        stamp = {"sec": 5 + t // 10**9, "nanosec": t % 10**9}
        yield "/joint", t, {"header": {"stamp": stamp}, "theta": THETA[k], "rates": [OMEGA[k]], "label": "x"}
        yield "/cmd", t, {"header": {"stamp": stamp}, "data": TORQUE[k]}


def write_json_mcap(path):
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in ("/joint", "/cmd")}
        for topic, time, content in messages():
            writer.add_message(channels[topic], time, json.dumps(content).encode(), time)
        writer.finish()


def ros_messages():
    """Yield topic, type, time [ns] and CDR data."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    none = np.zeros(0)
    for k, t in enumerate(np.round(T * 1e9).astype(int).tolist()):
        header = kinds["std_msgs/msg/Header"](
            stamp=kinds["builtin_interfaces/msg/Time"](sec=5 + t // 10**9, nanosec=t % 10**9), frame_id=""
        )
        joint = kinds[JOINTS](
            header=header, name=["a"], position=np.array([THETA[k]]), velocity=np.array([OMEGA[k]]), effort=none
        )
        yield "/joint", JOINTS, t, bytes(store.serialize_cdr(joint, JOINTS))
        wrench = "geometry_msgs/msg/WrenchStamped"
        vector = kinds["geometry_msgs/msg/Vector3"]
        push = kinds["geometry_msgs/msg/Wrench"](force=vector(x=TORQUE[k], y=0.0, z=0.0), torque=vector(x=0, y=0, z=0))
        yield "/cmd", wrench, t, bytes(store.serialize_cdr(kinds[wrench](header=header, wrench=push), wrench))


def write_ros_mcap(path):
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as stream:
        writer, channels = Writer(stream), {}
        writer.start()
        for topic, kind, time, data in ros_messages():
            if topic not in channels:
                text = store.generate_msgdef(kind, ros_version=2)[0].encode()
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
            writer.add_message(channels[topic], time, data, time)
        writer.finish()


def write_bag(path):
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        base.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        known = {}
        for topic, kind, time, data in ros_messages():
            if topic not in known:
                known[topic] = len(known) + 1
                base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (known[topic], topic, kind))
            base.execute(
                "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (known[topic], time, data)
            )
    base.close()


JSON_NAMES = {"/joint.theta": "theta", "/joint.rates.0": "omega", "/cmd.data": "u"}
ROS_NAMES = {"/joint.position.0": "theta", "/joint.velocity.0": "omega", "/cmd.wrench.force.x": "u"}
ROLES = {"states": ["theta", "omega"], "inputs": ["u"]}
FORMATS = {
    "log.mat": (write_mat, ROLES),
    "log73.mat": (write_mat73, ROLES),
    "log.h5": (write_h5, ROLES),
    "log.mf4": (write_mdf, ROLES),
    "json.mcap": (write_json_mcap, ROLES | {"columns": JSON_NAMES}),
    "ros.mcap": (write_ros_mcap, ROLES | {"columns": ROS_NAMES}),
    "bag.db3": (write_bag, ROLES | {"columns": ROS_NAMES}),
}


def strip(names):
    return [name.split(" [")[0] for name in names]


@pytest.mark.parametrize("name", FORMATS)
def test_a_log_reads_back_as_the_rows_that_its_tool_wrote(name, tmp_path):
    write, reading = FORMATS[name]
    write(tmp_path / name)
    data = km.load_episodes(tmp_path / name, **reading)
    assert (strip(data.states), strip(data.inputs), data.dt, len(data)) == (["theta", "omega"], ["u"], DT, 1)
    np.testing.assert_array_equal(data[0].X, np.column_stack([THETA, OMEGA]))
    np.testing.assert_array_equal(data[0].U[:, 0], TORQUE[:-1])


@pytest.mark.parametrize("name", ["log.h5", "log.mf4"])
def test_units_of_the_file_go_into_the_names(name, tmp_path):
    write, reading = FORMATS[name]
    write(tmp_path / name)
    data = km.load_episodes(tmp_path / name, **reading)
    assert data.states[0] == "theta [rad]"
    assert data.inputs == ("u [N m]",)


def test_a_folder_of_recordings_is_a_source(tmp_path):
    for i in range(2):
        write_mdf(tmp_path / f"{i}.mf4", start=100.0 * i)
    files = km.data.Files(tmp_path, **ROLES)
    assert sum(len(part.load()) for part in files.parts()) == 2


@pytest.mark.parametrize("slow", [1, 4])
@pytest.mark.parametrize(("name", "history"), [("log.mf4", 0), ("log.mf4", 3), ("json.mcap", 2)])
def test_the_parts_of_a_large_recording_hold_each_pair_once(name, history, slow, tmp_path, monkeypatch):
    write, reading = FORMATS[name]
    write(tmp_path / name, slow) if name == "log.mf4" else write(tmp_path / name)
    with pytest.warns(km.FitWarning, match="clocks of their own") if name == "log.mf4" and slow > 1 else no_warning():
        whole = km.load_episodes(tmp_path / name, **reading)
    monkeypatch.setattr(recording, "LARGE", 10)
    monkeypatch.setattr(recording, "PART", 150)
    files = km.data.Files(tmp_path / name, **reading)
    parts = [part.load() for part in files.parts(history)]
    assert len(parts) > 4
    pairs = [np.hstack([e.X[:-1], e.U, e.X[1:]]) for part in parts for e in part]
    kept = [pairs[0], *(rows[history:] for rows in pairs[1:])]  # the first part begins with the record
    X, U, X_next = (getattr(whole.snapshots(), field) for field in ("X", "U", "X_next"))
    np.testing.assert_array_equal(np.vstack(kept), np.hstack([X, U, X_next]))


def no_warning():
    import contextlib

    return contextlib.nullcontext()


@settings(max_examples=20, deadline=None)
@given(fast=st.integers(2, 9), offset=st.floats(0, 0.05), seed=st.integers(0, 99))
def test_channels_of_unequal_rates_meet_on_one_grid(fast, offset, seed, tmp_path_factory):
    rng = np.random.default_rng(seed)
    slope, t, s = rng.normal(), 0.03 * np.arange(200), offset + 0.03 / fast * np.arange(190 * fast)
    samples = [(t, slope * t), (s, 1 - slope * s), (s, np.floor(3 * s))]

    class Three(recording.Recording):
        def channels(self):
            return tuple(recording_channel(n, len(v[0])) for n, v in zip(("a", "b", "u"), samples, strict=True))

        def span(self):
            return 0.0, 6.0

        def read(self, names, begin=-np.inf, end=np.inf, count=None):
            found = [samples["abu".index(name)] for name in names]
            keep = [(x >= begin) & (x <= end) for x, _ in found]
            return [(x[k][:count], v[k][:count]) for (x, v), k in zip(found, keep, strict=True)]

    with pytest.warns(km.FitWarning, match="clocks of their own"):
        data = recording.read_recording(tmp_path_factory.getbasetemp() / "x", Three(), TableSettings())
    assert data.dt == pytest.approx(0.03)
    (episode,) = data
    time = (episode.X[:, 0] / slope) if abs(slope) > 1e-3 else None
    if time is not None:  # lines are interpolated without error, inputs hold the last value before the row
        np.testing.assert_allclose(np.diff(time), 0.03, rtol=1e-6)
        np.testing.assert_allclose(episode.X[:, 1], 1 - slope * time, atol=1e-9)
        held = [np.floor(3 * s[np.searchsorted(s, at + 1e-9, "right") - 1]) for at in time[:-1]]
        np.testing.assert_array_equal(episode.U[:, 0], held)


def recording_channel(name, count):
    from koopmpc.data.files.formats import Channel

    return Channel(name, "", count)


def test_a_silent_channel_ends_an_episode(tmp_path):
    from asammdf import MDF, Signal

    keep = (T < 1.0) | (T > 1.5)
    with MDF(version="4.10") as mdf:
        mdf.append([Signal(THETA, T, name="theta")])
        mdf.append([Signal(OMEGA[keep], T[keep], name="omega"), Signal(TORQUE[keep], T[keep], name="u")])
        mdf.save(tmp_path / "gap.mf4")
    with pytest.warns(km.FitWarning):
        data = km.load_episodes(tmp_path / "gap.mf4", **ROLES)
    assert len(data) == 2
    assert sum(len(e) + 1 for e in data) == keep.sum()


def test_too_many_channels_are_not_guessed(tmp_path):
    from asammdf import MDF, Signal

    with MDF(version="4.10") as mdf:
        mdf.append([Signal(np.sin(k + T), T, name=f"s{k}") for k in range(25)])
        mdf.save(tmp_path / "many.mf4")
    with pytest.raises(km.KoopmpcError, match=r"25 channels, too many to guess.*states= and inputs="):
        km.load_episodes(tmp_path / "many.mf4")


def test_a_struct_and_a_sample_time_of_matlab(tmp_path):
    from scipy.io import savemat

    savemat(tmp_path / "a.mat", {"log": {"y": np.column_stack([THETA, OMEGA]), "u": TORQUE, "fs": 100.0}})
    data = km.load_episodes(tmp_path / "a.mat")
    assert (data.states, data.inputs, data.dt) == (("y1", "y2"), ("u",), DT)


def test_a_variable_of_another_length_is_named_and_left_out(tmp_path):
    write_mat(tmp_path / "a.mat", table=np.arange(7.0))
    with pytest.warns(km.FitWarning, match=r"table has another number of rows than the 400"):
        assert km.load_episodes(tmp_path / "a.mat", **ROLES).nx == 2


@pytest.mark.parametrize(("name", "package", "extra"), [
    ("log73.mat", "h5py", "hdf5"), ("log.h5", "h5py", "hdf5"), ("log.mf4", "asammdf", "mdf"), ("ros.mcap", "mcap", "ros"),
])  # fmt: skip
def test_a_missing_package_is_named_with_its_extra(name, package, extra, tmp_path, monkeypatch):
    write, reading = FORMATS[name]
    write(tmp_path / name)
    for module in [m for m in sys.modules if m.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    for module in (package, f"{package}.reader"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(km.KoopmpcError, match=rf"{package}.*\[{extra}\]"):
        km.load_episodes(tmp_path / name, **reading)


def test_a_schema_that_is_not_understood_is_named(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "p.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/pose", "protobuf", writer.register_schema("Pose", "protobuf", b""))
        writer.add_message(channel, 0, b"\x00", 0)
        writer.finish()
    with pytest.raises(km.KoopmpcError, match=r"/pose holds protobuf messages.*CDR"):
        km.load_episodes(tmp_path / "p.mcap")


def test_columns_rename_and_a_name_that_is_not_there_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("t,y [V],u\n0,1,2\n0.1,2,3\n0.2,4,4\n")
    assert km.load_episodes(tmp_path / "a.csv", columns={"y": "level"}).states == ("level [V]",)
    with pytest.raises(km.KoopmpcError, match=r"no column 'z' to rename; its columns are t, y \[V\], u"):
        km.load_episodes(tmp_path / "a.csv", columns={"z": "level"})


def test_a_frame_reads_back_to_the_bit():
    rng = np.random.default_rng(0)
    episodes = [
        km.Episode(X=rng.normal(size=(n + 1, 2)), U=rng.normal(size=(n, 1)), W=rng.normal(size=(n, 1))) for n in (5, 9)
    ]
    data = km.Episodes(episodes, 0.1, ["a [m]", "b"], ["u"], ["w"])
    again = km.Episodes.from_frame(data.to_frame(), states=["a [m]", "b"], inputs=["u"], disturbances=["w"])
    assert again == data
    assert km.load_episodes(data.to_frame(), states=["a [m]", "b"], inputs=["u"], disturbances=["w"]) == data


@pytest.mark.parametrize("clock", ["index", "datetime", "timedelta", "seconds"])
def test_each_kind_of_clock_of_a_frame_gives_the_same_sample_time(clock):
    frame = pd.DataFrame({"theta": THETA, "u": TORQUE})
    stamps = pd.Timestamp("2026-11-24 12:00") + pd.to_timedelta(T, unit="s")
    if clock == "index":
        frame.index = stamps
    else:
        frame["when"] = {"datetime": stamps, "timedelta": pd.to_timedelta(T, unit="s"), "seconds": T}[clock]
    data = km.Episodes.from_frame(frame, time=None if clock == "index" else "when")
    assert (data.dt, data.states, data.inputs) == (DT, ("theta",), ("u",))


def test_episodes_of_a_frame_by_a_column_of_names():
    frame = pd.DataFrame(
        {"batch": ["a"] * 3 + ["b"] * 4, "t": [0, 1, 2, 0, 1, 2, 3], "x": np.arange(7.0) ** 2, "u": 1.5}
    )
    with pytest.warns(km.FitWarning, match="'u' is 1.5 throughout"):
        assert [len(e) for e in km.Episodes.from_frame(frame, by="batch")] == [2, 3]


def test_a_frame_without_the_column_asked_for_is_refused():
    with pytest.raises(km.KoopmpcError, match=r"no column 'when' for time=; its columns are x"):
        km.Episodes.from_frame(pd.DataFrame({"x": [1.0, 2.0]}), time="when")
    with pytest.raises(km.KoopmpcError, match="frame is a list"):
        km.Episodes.from_frame([1, 2])


def fit_states(data):
    return km.edmd(data, km.State())


@pytest.mark.unhooked
def test_a_path_or_a_frame_in_the_place_of_data_names_what_reads_it():
    frame = pd.DataFrame({"x": [1.0, 2.0, 4.0], "u": [1.0, 2.0, 1.0]})
    for wrong, said in ((frame, "frame"), ("logs.csv", "'logs.csv'")):
        for use in (fit_states, km.select, km.validate.audit):
            with pytest.raises(km.KoopmpcError, match=rf"pass km\.load_episodes\({said}\), which reads it"):
                use(wrong)
    with pytest.raises(km.KoopmpcError, match=r"no file; pass km\.load_episodes\(frame\)"):
        km.data.Files(frame)


def damage(content: bytes, rng: np.random.Generator) -> bytes:
    """Return the file cut short, with bytes changed, or with a stretch of it doubled or zeroed."""
    kind, n = rng.integers(4), len(content)
    if kind == 0:
        return content[: rng.integers(n)]
    a = int(rng.integers(n))
    if kind == 1:
        return content[:a] + bytes(rng.integers(0, 256, 1 + rng.integers(8), dtype=np.uint8)) + content[a + 8 :]
    b = min(a + int(rng.integers(1, 400)), n)
    return content[:a] + (content[a:b] * 2 if kind == 2 else bytes(b - a)) + content[b:]


@pytest.mark.parametrize("count", [12, pytest.param(300, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused_in_a_sentence(name, count, tmp_path, recwarn):
    write, reading = FORMATS[name]
    write(tmp_path / name)
    said: list[str] = []
    content, rng = (tmp_path / name).read_bytes(), np.random.default_rng(7)
    for i in range(count):
        path = tmp_path / f"{i}{name[name.index('.') :]}"
        path.write_bytes(damage(content, rng))
        try:
            data = km.load_episodes(path, **reading)
        except km.KoopmpcError as error:
            said.append(str(error))
        else:
            assert data.nx == 2
            assert all(np.isfinite(episode.X).all() for episode in data)
    assert said
    assert all(name[:4] in text or str(tmp_path) in text for text in said)


def test_a_run_as_a_frame_holds_every_row():
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    mpc = km.LQR(km.LinearPredictor.local(plant, [0, 0], [0]), km.Cost(Q=[10, 1], R=0.1))
    run = km.simulate(plant, mpc, x0=[0.2, 0], reference=[0, 0], steps=20)
    frame = run.to_frame()
    np.testing.assert_array_equal(frame[list(run.states)].to_numpy(), run.X)
    np.testing.assert_array_equal(frame[list(run.inputs)].to_numpy()[:-1], run.U)
    np.testing.assert_array_equal(frame[[f"measured {name}" for name in run.outputs]].to_numpy(), run.Y)
    statuses = [None if pd.isna(name) else name for name in frame["status"]]
    assert statuses == [status.name for status in map(km.Status, run.status)] + [None]


@pytest.mark.parametrize("size", [70, 100, 200, 400])
def test_a_file_cut_in_its_header_leaves_nothing_that_raises_later(size, tmp_path, monkeypatch, capfd):
    write_mdf(tmp_path / "log.mf4")
    whole = (tmp_path / "log.mf4").read_bytes()
    (tmp_path / "cut.mf4").write_bytes(whole[:size])
    raised = []
    monkeypatch.setattr(sys, "unraisablehook", raised.append)
    with pytest.raises(km.errors.LogError, match="cannot be read as MDF"):
        km.load_episodes(tmp_path / "cut.mf4", **ROLES)
    gc.collect()
    assert not raised
    assert capfd.readouterr() == ("", "")


def write_formula(path, formula, *, version="4.10", time=False, inside=False):
    """Write theta as a raw channel with an algebraic conversion, by the library that other tools write with."""
    from asammdf import MDF, Signal

    conversion = {"formula": formula}
    if inside:
        conversion = {"lower_0": 5.0, "upper_0": 6.0, "text_0": b"far", "default_addr": f'"{{X}}*({formula})"'.encode()}
    with MDF(version=version) as mdf:
        signal = Signal(THETA, T, name="theta", unit="rad", conversion=conversion)
        mdf.append([signal, Signal(TORQUE, T, name="u")])
        if time:
            master = mdf.groups[0].channels[mdf.masters_db[0]]
            master.conversion = mdf.groups[0].channels[1].conversion
        mdf.save(path, overwrite=True)


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("2*X+3", 2 * THETA + 3),
        ("-(X - 1)^2 / 4", -((THETA - 1) ** 2) / 4),
        ("exp(X) + sqrt(abs(X))", np.exp(THETA) + np.sqrt(np.abs(THETA))),
        ("pow(X, 2) - 1e-3 * log10(3 + X)", THETA**2 - 1e-3 * np.log10(3 + THETA)),
        ("(X + 2) ** -1", 1 / (THETA + 2)),
        ("X - X + 2.5", np.full_like(THETA, 2.5)),
    ],
)
@pytest.mark.parametrize("version", ["4.10", "3.30"])
def test_a_channel_with_a_formula_is_computed_by_arithmetic(formula, value, version, tmp_path):
    path = tmp_path / f"log.{'mf4' if version[0] == '4' else 'mdf'}"
    write_formula(path, formula, version=version)
    episodes = km.load_episodes(path, states=["theta"], inputs=["u"])
    np.testing.assert_allclose(episodes[0].X[:, 0], value, rtol=1e-12)


@pytest.mark.parametrize("version", ["4.10", "3.30"])
@pytest.mark.parametrize(
    "formula",
    [
        "__import__('pathlib').Path('{ran}').touch()",
        "[open('{ran}','w') for _ in (1,)][0]",
        "(lambda: open('{ran}','w'))()",
        "X.__class__",
        "X if X else 2",
        "X; 2",
        "sin(X, 2)",
        "foo(X)",
        "X[0]",
        "1j*X",
        "(" * 900 + "X" + ")" * 900,
    ],
)
def test_a_formula_with_anything_but_arithmetic_is_refused_by_name_and_runs_nothing(
    formula, version, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"log.{'mf4' if version[0] == '4' else 'mdf'}"
    write_formula(path, formula.replace("{ran}", "ran"), version=version)
    with pytest.raises(km.errors.LogError, match=r"'theta' is converted by the formula .* export the log"):
        km.load_episodes(path, states=["theta"], inputs=["u"])
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(("where", "message"), [("time", "for the time of its group"), ("inside", "inside another")])
def test_formulas_of_clocks_and_inside_tables_are_refused_by_name(where, message, tmp_path):
    write_formula(tmp_path / "log.mf4", "X*2", **{where: True})
    with pytest.raises(km.errors.LogError, match=message):
        km.load_episodes(tmp_path / "log.mf4", states=["theta"], inputs=["u"])


def test_a_heap_on_which_the_hdf5_library_walks_for_ever_is_refused(tmp_path):
    write_h5(tmp_path / "log.h5")
    content = bytearray((tmp_path / "log.h5").read_bytes())
    start = content.index(b"GCOL\x01")
    place = start + 16
    while number := int.from_bytes(content[place : place + 2], "little"):
        place += 16 + -(-int.from_bytes(content[place + 8 : place + 16], "little") // 8) * 8
    assert number == 0
    content[place + 8 : place + 16] = bytes(8)  # free space of no length
    (tmp_path / "log.h5").write_bytes(content)
    code = (
        "import sys, koopmpc as km\ntry:\n    km.load_episodes(sys.argv[1])\nexcept km.KoopmpcError as e:\n    print(e)"
    )
    done = subprocess.run(  # in a process of its own, which can be ended
        [sys.executable, "-c", code, str(tmp_path / "log.h5")], capture_output=True, text=True, timeout=300, check=True
    )
    assert "log.h5 cannot be read as HDF5: a heap of texts is damaged; take another copy" in done.stdout
