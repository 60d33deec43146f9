import importlib
import json
import pkgutil
import subprocess
import sys
from dataclasses import dataclass, fields, replace
from inspect import isabstract

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.base.values import Value, from_data, same, to_data

STATES = ("theta [rad]", "omega [rad/s]")


def through_json(value, enums=()):
    return from_data(json.loads(json.dumps(to_data(value))), enums=enums)


@st.composite
def arrays(draw):
    dtype = draw(st.sampled_from(["float64", "float32", "int64", "int32", "bool", "complex128", "uint8"]))
    shape = draw(st.sampled_from([(), (0,), (3,), (2, 3), (0, 2), (2, 1, 2)]))
    raw = draw(st.binary(min_size=1, max_size=16))
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if dtype == "bool":
        return (np.resize(np.frombuffer(raw, np.uint8), shape) % 2).astype(bool)
    with np.errstate(invalid="ignore"):
        array = np.frombuffer((raw * (size // len(raw) + 1))[:size], dtype).reshape(shape).copy()
    if array.dtype.kind in "fc":
        parts = array.reshape(-1).view(f"f{array.itemsize // (2 if array.dtype.kind == 'c' else 1)}")
        parts[np.isnan(parts)] = np.nan  # JSON knows one NaN
    return array


@given(value=arrays())
def test_arrays_survive_json_to_the_bit(value):
    back = through_json(value)
    assert same(back, value)
    assert same(value, back)
    kept = {}
    tree = json.loads(json.dumps(to_data(value, kept)))
    assert same(from_data(tree, kept), value)


@given(
    value=st.recursive(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text()),
        lambda s: st.one_of(st.lists(s, max_size=3).map(tuple), st.dictionaries(st.text(max_size=5), s, max_size=3)),
        max_leaves=12,
    )
)
def test_trees_survive_json_to_the_bit(value):
    assert same(through_json(value), value)


def test_equality_is_to_the_bit():
    plus, minus = (
        km.loop.Plans(np.zeros((1, 2, 1)), np.zeros((1, 1, 1))),
        km.loop.Plans(np.zeros((1, 2, 1)), -np.zeros((1, 1, 1))),
    )
    assert plus != minus
    assert plus == replace(plus)
    nan = km.loop.Plans(np.full((1, 2, 1), np.nan), np.zeros((1, 1, 1)))
    assert nan == replace(nan, X=nan.X.copy())
    assert plus != km.Cost(1, 1)
    assert plus != 3
    assert same(float("nan"), float("nan"))
    for a, b in (
        (0.0, -0.0),
        (1.0, 1.0 + 2**-52),
        (np.zeros(2), np.zeros(3)),
        (np.zeros(2), np.zeros(2, np.float32)),
        (np.zeros((2, 1)), np.zeros((1, 2))),
        (np.zeros(2), [0.0, 0.0]),
        ([0.0], np.zeros(1)),
        (np.zeros(1), 0.0),
        ((1, 2), (1, 2, 3)),
        ({"a": 1}, {"b": 1}),
        ({"a": 1}, {"a": 2}),
        ("a", 1),
        (None, 0.5),
    ):
        assert not same(a, b)
        assert not same(b, a)
    with pytest.raises(TypeError, match="unhashable"):
        hash(plus)


VALUES = {
    "cost": km.Cost([1, 2], [[2, 1], [1, 3]], Q_N=np.eye(2), of=km.Fourier(2, states="theta"), u_target="zero"),
    "limits": km.Limits(-1, [1, np.inf], of=km.Monomials(2), y_max=3, slack=None),
    "soft": km.Limits(x_min=[-np.inf, 0], slack=(3.0, 0.0)),
    "sum": (km.State() + km.Fourier(1) + km.Constant()).bind(STATES),
    "thin plate": km.ThinPlate(np.array([[0.1, 1 / 3]])),
    "gaussian": km.Gaussian(np.array([[0.1, 1 / 3]]), 0.7).bind(STATES),
    "expressions": km.Expressions(lambda x: [x[0] * x[1], x[1] ** 2], ["a", "b"]).bind(STATES),
    "plan": km.control.Plan(np.array([[0.1, np.nan], [-0.0, 1e-300]]), np.array([[np.inf]])),
    "plans": km.loop.Plans(np.full((2, 3, 2), np.nan), np.ones((2, 2, 1))),
}


@pytest.mark.parametrize("name", VALUES)
def test_values_survive_json_to_the_bit(name):
    value = VALUES[name]
    back = through_json(value)
    assert type(back) is type(value)
    assert back == value
    for field in fields(value):
        if isinstance(getattr(value, field.name), np.ndarray):
            assert getattr(back, field.name).flags["C_CONTIGUOUS"]


def test_a_value_still_works_after_a_round_trip():
    lifting = VALUES["expressions"]
    x = np.array([[0.3, -0.7], [2.0, 1.0]])
    np.testing.assert_array_equal(through_json(lifting)(x), lifting(x))
    cost = through_json(VALUES["cost"])
    np.testing.assert_array_equal(cost.matrices(2, 2)[1], [[2, 1], [1, 3]])


def test_enums_come_back_where_they_are_named():
    tree = (km.Status.OPTIMAL, km.control.Fallback.HOLD)
    assert through_json(tree, enums=(km.Status, km.control.Fallback)) == tree
    with pytest.raises(km.errors.LogError, match=r"holds a 'Status', which this version of koopmpc does not know"):
        through_json(tree)
    with pytest.raises(km.errors.LogError, match=r"holds a 'Status' that cannot be built: 'GREAT'"):
        from_data({"kind": "Status", "name": "GREAT"}, enums=(km.Status,))


@dataclass(frozen=True, eq=False)
class Mine(Value):
    """A Value of somebody else's module."""

    a: float = 1.0


def test_what_cannot_be_saved_is_named():
    with pytest.raises(km.errors.DataError, match=r"Mine is not a class of koopmpc and cannot be saved as data"):
        to_data(Mine())
    with pytest.raises(km.errors.LogError, match=r"holds a 'Mine', which this version"):
        from_data({"kind": "Mine", "a": 2.0})
    with pytest.raises(km.errors.DataError, match=r"a set cannot be saved as data; use numbers, names and arrays"):
        to_data({1, 2})
    with pytest.raises(km.errors.DataError, match=r"Expressions holds a Python function; call .bind\(states\)"):
        to_data(km.Expressions(lambda x: [x[0]], ["a"]))


def test_numpy_scalars_become_plain_numbers():
    tree = to_data({"a": np.float64(0.5), "b": np.int64(3), "c": np.bool_(True), "d": np.str_("s")})
    assert json.loads(json.dumps(tree))["items"] == [["a", 0.5], ["b", 3], ["c", True], ["d", "s"]]


HOSTILE = [
    {"kind": "os.system", "command": "true"},
    {"kind": "Popen"},
    {"kind": None},
    {},
    {"kind": ["Cost"]},
    {"kind": {"kind": "Cost"}},
    {"kind": "Value"},
    {"kind": "Cost"},
    {"kind": "Cost", "Q": 1, "R": 1, "extra": 2},
    {"kind": "Cost", "Q": -1, "R": 1},
    {"kind": "Cost", "Q": "x", "R": 1},
    {"kind": "Cost", "Q": 1, "R": 1, "u_target": "nowhere"},
    {"kind": "Limits", "u_min": 2, "u_max": 1},
    {"kind": "Limits", "slack": [1, 2, 3]},
    {"kind": "Sum", "parts": [1, 2], "bound": ["a"]},
    {"kind": "Expressions", "fn": "__import__", "labels": ["a"]},
    {"kind": "Expressions", "fn": "__import__", "names": 5},
    {"kind": "LinearPredictor", "A": 1, "B": 1, "C": 1, "lifting": 5, "dt": 1, "states": ["x"], "inputs": []},
    {"kind": "array"},
    {"kind": "array", "dtype": "object", "shape": [1], "values": [None]},
    {"kind": "array", "dtype": "O", "shape": [1], "values": ["x"]},
    {"kind": "array", "dtype": "U5", "shape": [1], "values": ["x"]},
    {"kind": "array", "dtype": "V8", "shape": [1], "values": ["x"]},
    {"kind": "array", "dtype": "M8[s]", "shape": [1], "values": [0]},
    {"kind": "array", "dtype": "f8", "shape": [3], "values": [0]},
    {"kind": "array", "dtype": "f8", "shape": [-1, 0], "values": [0]},
    {"kind": "array", "dtype": "f8", "shape": "x", "values": [0]},
    {"kind": "array", "dtype": "f8", "shape": [1], "values": ["x"]},
    {"kind": "array", "dtype": "i8", "shape": [1], "values": [10**30]},
    {"kind": "array", "dtype": "nothing", "shape": [1], "values": [0]},
    {"kind": "array", "dtype": [["a", "O"]], "shape": [1], "values": [0]},
    {"kind": "array", "key": "missing"},
    {"kind": "array", "key": ["array0"]},
    {"kind": "array", "key": "objects"},
    {"kind": "dict"},
    {"kind": "dict", "items": [["a"]]},
    {"kind": "dict", "items": [[["a"], 1]]},
    {"kind": "dict", "items": 3},
    [1, [2, {"kind": "eval"}]],
    {"kind": "Cost", "Q": {"kind": "eval"}, "R": 1},
]


@pytest.mark.parametrize("tree", HOSTILE, ids=str)
def test_a_hostile_tree_is_a_log_error(tree):
    with pytest.raises(km.errors.LogError, match=r"the file holds a"):
        from_data(tree, {"objects": np.array([object()], dtype=object), "array0": np.zeros(1)})


def hostile(value, **fields):
    return to_data(value) | fields


STATE = to_data(km.State().bind(STATES))
MODEL = km.LinearPredictor(np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), 0.1, states=STATES, inputs=("u",))
WRONG_TYPES = [
    hostile(km.State() + km.Constant(), parts=[STATE, 2], bound=["a"]),
    hostile(km.State() + km.Constant(), parts=STATE),
    hostile(km.State() * km.State(), first=3),
    hostile(km.State() * km.State(), second={"kind": "array", "dtype": "f8", "shape": [1], "values": [0]}),
    hostile(km.Constant(), bound="theta"),
    hostile(km.Constant(), bound=[1, 2]),
    hostile(km.State(), states=[[1]]),
    hostile(km.Delay(2), bound=[["a"]]),
    hostile(MODEL, report=5),
    hostile(MODEL, report=STATE),
    hostile(MODEL, embedding=STATE),
    hostile(km.control.Plan(np.zeros((2, 1)), np.zeros((1, 1))), U=[[1]]),
    hostile(km.control.Plan(np.zeros((2, 1)), np.zeros((1, 1))), X=to_data(np.zeros(3))),
    hostile(km.control.Plan(np.zeros((2, 1)), np.zeros((1, 1))), X=to_data(np.zeros((2, 1), int))),
    hostile(km.loop.Plans(np.zeros((2, 3, 1)), np.zeros((2, 2, 1))), U=to_data(np.zeros((3, 2, 1)))),
]


@pytest.mark.parametrize("tree", WRONG_TYPES, ids=lambda tree: f"{tree['kind']}")
def test_a_field_of_another_type_than_the_class_declares_is_a_log_error(tree):
    with pytest.raises(km.errors.LogError, match=r"the file holds a '\w+' (with \w+=.*, which is of|that cannot be)"):
        from_data(json.loads(json.dumps(tree)))


def test_each_name_is_one_class():
    """A file names classes by their bare names, so no two may share one."""
    for module in pkgutil.walk_packages(importlib.import_module("koopmpc").__path__, "koopmpc."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)

    def below(cls):
        return {cls}.union(*(below(c) for c in cls.__subclasses__()))

    classes = [c for c in below(Value) - {Value} if c.__module__.startswith("koopmpc.")]
    assert len({c.__name__ for c in classes}) == len(classes)
    assert not [c for c in classes if "kind" in getattr(c, "__dataclass_fields__", {})]


def test_a_repr_is_a_line_without_numbers():
    data = km.Episodes([km.Episode(X=np.zeros((9, 2)), U=np.zeros((8, 1)))] * 7, 0.1)
    assert repr(data[0]) == "Episode(U=array(8, 1), X=array(9, 2), W=array(8, 0))"
    assert repr(data[:1]).startswith("Episodes(episodes=(Episode,), dt=0.1, states=('x0', 'x1'), inputs=('u0',)")
    assert repr(data).startswith("Episodes(episodes=(Episode, Episode, Episode, Episode, … 7 in all), dt=0.1,")
    assert repr(km.Fourier(2, [0])) == "Fourier(bound=None, harmonics=2, states=(0,))"
    about = {str(i): i for i in range(9)} | {"0": "long" * 99}
    plan = replace(_run(), metadata=about, cost=km.Cost(Q=[1.0, 2.0], R=[1.0]))
    text = repr(plan)
    assert len(text) < 1200
    assert "\n" not in text
    for part in (
        "X=array(201, 2)",
        "cost=Cost,",
        "Status.OPTIMAL, … 200 in all)",
        "'1': 1, '2': 2, '3': 3, … 9 in all}",
    ):
        assert part in text


def _run() -> km.Run:
    return km.Run(
        X=np.zeros((201, 2)),
        Y=np.zeros((201, 2)),
        U=np.zeros((200, 1)),
        reference=np.zeros((201, 2)),
        status=(km.Status.OPTIMAL,) * 200,
        fallback=(km.control.Fallback.NONE,) * 200,
        solve_time=np.zeros(200),
        iterations=np.zeros(200, dtype=np.int64),
        cost=None,
        limits=None,
        dt=0.1,
        states=("a", "b"),
        inputs=("u",),
        outputs=("a", "b"),
    )


def test_a_fresh_process_knows_every_class_that_a_saved_model_or_controller_may_name():
    families = [cls for cls in descendants(km.Lifting) if cls.__module__.startswith("koopmpc.lifting.")]
    served = [getattr(km, name) for name in km.__all__]
    values = [each for each in served if isinstance(each, type) and issubclass(each, Value)]
    names = sorted({cls.__name__ for cls in families + values if not isabstract(cls)})
    assert {"Eigenfunction", "LiftedKalman", "Feedback"} <= set(names)
    names += ["TrustReport", "Selection"]
    code = (
        "from koopmpc.base.values import Value, class_of; import sys; assert not Value._kinds\n"
        f"print([name for name in {names} if class_of(name) is None])\n"
        "assert class_of('Popen') is None and class_of('trust') is None and 'rerun' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def descendants(cls):
    return [each for direct in cls.__subclasses__() for each in (direct, *descendants(direct))]
