"""A saved predictor comes back to the bit; what is no predictor is refused with words."""

import io
import json
import pickle
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import random_episodes

DATA = random_episodes(0, [80, 60], 2, 1)
CENTERS = [[0.0, 0.5], [0.2, -0.7]]


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    km.edmd(DATA, LIFTINGS[0]).save(tmp_path / "model.npz")
    return tmp_path / "model.npz"


LIFTINGS = [
    km.State() + km.Constant() + km.Fourier(2, states=[0]),
    km.State() + km.Monomials(3),
    km.State() + km.ThinPlate(CENTERS) + km.Gaussian(CENTERS, 0.8),
    km.State() + km.Expressions(lambda x: [x[0] * ca.exp(-(x[1] ** 2))], ["bump"]),
]


@pytest.mark.parametrize("rank", [None, 2])
@pytest.mark.parametrize("lifting", LIFTINGS, ids=lambda each: str(each.bind(DATA.states).nz))
def test_a_predictor_comes_back_to_the_bit(lifting, rank: int | None, tmp_path: Path) -> None:
    model = km.edmd(DATA, lifting, rank=rank)
    model.save(tmp_path / "model.npz")
    again = km.load_model(tmp_path / "model.npz")
    assert again == model
    assert again.report == model.report
    U = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    assert np.array_equal(again.rollout([0.1, 0.2], U), model.rollout([0.1, 0.2], U))
    assert np.array_equal(again.modes, model.modes)


def test_equality_sees_one_bit(saved: Path) -> None:
    model = km.load_model(saved)
    A = np.array(model.A)
    A[0, 0] = np.nextafter(A[0, 0], 2)
    other = km.LinearPredictor(A, model.B, model.C, model.lifting, model.dt, model.states, model.inputs, model.report)
    assert other != model


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(
        km.errors.LogError, match=r"nothing\.npz does not exist; pass the \.npz of a saved LinearPredictor"
    ):
        km.load_model(tmp_path / "nothing.npz")


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04 no zip", pickle.dumps([1, 2])])
def test_a_file_of_something_else(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.npz").write_bytes(content)
    told = "is damaged, or koopmpc did not save it: it is no .npz file, or was cut; pass the .npz of a saved"
    with pytest.raises(km.errors.LogError, match=told) as caught:
        km.load_model(tmp_path / "model.npz")
    assert "pickle" not in str(caught.value)


def test_a_folder_is_said_to_be_one(saved: Path) -> None:
    with pytest.raises(km.errors.LogError, match=r"is a folder; pass the \.npz of a saved LinearPredictor"):
        km.load_model(saved.parent)
    with pytest.raises(km.errors.LogError, match=r"is a folder; pass the path of a file in it"):
        km.load_model(saved).save(saved.parent)


def test_folders_are_made_and_what_cannot_be_written_is_told(saved: Path) -> None:
    model = km.load_model(saved)
    model.save(saved.parent / "new" / "er" / "model.npz")
    assert km.load_model(saved.parent / "new" / "er" / "model.npz") == model
    with pytest.raises(km.errors.LogError, match=r"model\.npz/model\.npz cannot be written: .+; pass another path"):
        model.save(saved / "model.npz")


def outcome(path: Path) -> km.LinearPredictor | str:
    """Return the predictor, or the text of the LogError."""
    try:
        return km.load_model(path)
    except km.errors.LogError as error:
        return str(error)


def test_any_cut_is_refused_and_any_flipped_byte_is_refused_or_harmless(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    model = km.load_model(saved)
    bad = tmp_path / "bad.npz"
    for i in range(0, len(whole), 37):
        bad.write_bytes(whole[:i])
        assert str(bad) in outcome(bad)
        bad.write_bytes(whole[:i] + bytes([whole[i] ^ 0x55]) + whole[i + 1 :])
        got = outcome(bad)
        assert got == model or str(bad) in got


def test_a_pickle_inside_is_not_opened(tmp_path: Path) -> None:
    opened: list[int] = []

    class Trap:
        def __reduce__(self) -> tuple[object, ...]:
            return opened.append, (1,)

    path = tmp_path / "trap.npz"
    np.savez(path, tree=np.array([Trap()], dtype=object), allow_pickle=True)
    with pytest.raises(
        km.errors.LogError, match="it is damaged, or holds something other than arrays of numbers; pass"
    ):
        km.load_model(path)
    assert not opened


def value(**fields: object):
    """Return the change that sets these fields of the predictor; `...` removes one."""

    def change(tree: dict) -> dict:
        held = {k: v for k, v in (tree["value"] | fields).items() if v is not ...}
        return tree | {"value": held}

    return change


def edited(source: Path, target: Path, change) -> Path:
    """Write a copy of a saved predictor whose JSON text was changed by hand."""
    with np.load(source) as file:
        arrays = {name: file[name] for name in file.files}
    tree = json.loads(arrays.pop("tree").tobytes())
    tree = change(tree)
    np.savez(target, tree=np.frombuffer(json.dumps(tree).encode(), dtype=np.uint8), **arrays)
    return target


NEWER = ("E", "M", "S", "disturbances", "input_lead", "rails", "scale")  # fields that models had not at first


def without_newer_fields(tree: dict) -> dict:
    return {k: without_newer_fields(v) if isinstance(v, dict) else v for k, v in tree.items() if k not in NEWER}


@pytest.mark.parametrize(
    "fit",
    [
        lambda data: km.edmd(data, km.State() + km.Constant(), embedding=km.Delay(2)),
        lambda data: km.bilinear_edmd(data, km.State() + km.Constant(), embedding=km.Delay(1)),
        lambda data: km.identify.polynomial_state_space(data, order=1, degree=2),
        lambda data: km.identify.subspace(data, order=2),
    ],
    ids=["delays", "bilinear delays", "polynomial hidden state", "linear hidden state"],
)
def test_a_model_file_of_before_has_the_newer_fields_at_their_defaults(fit, tmp_path: Path) -> None:
    data = random_episodes(0, [300], 1, 1)
    model = fit(data)
    model.save(tmp_path / "model.npz")
    again = km.load_model(edited(tmp_path / "model.npz", tmp_path / "old.npz", without_newer_fields))
    assert (again.input_lead, again.embedding, again.disturbances) == (0, model.embedding, ())
    past = again.embedding.steps
    history = km.Episode(X=data[0].X[: past + 1], U=data[0].U[:past])
    U = data[0].U[past : past + 20]
    runs = [one.rollout(data[0].X[past], U, history=history) for one in (model, again)]
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda t: t | {"format": "koopmpc-99"}, "is not a koopmpc-1 file; save it again with this version"),
        (lambda t: [1, 2], "is not a koopmpc-1 file"),
        (value(kind="os.system"), "holds a 'os.system', which this version"),
        (value(lifting={"kind": "Popen", "args": ["ls"]}), "holds a 'Popen', which this version"),
        (value(lifting="State"), "is damaged, or was made by hand|cannot be built"),
        (value(extra=1), "'LinearPredictor' that cannot be built"),
        (value(dt=...), "'LinearPredictor' that cannot be built"),
        (value(dt=-1.0), "dt is -1 s; it must be above zero"),
        (value(A={"kind": "array", "key": "array99"}), "'array' that cannot be built"),
        (value(states=["a", "b", "c"]), "cannot be built"),
        (lambda t: t | {"value": t["value"]["report"]}, "holds a FitReport, not a LinearPredictor"),
        (lambda t: {"format": t["format"]}, "holds a NoneType, not a LinearPredictor"),
    ],
)
def test_a_file_made_by_hand_is_refused(change, text: str, saved: Path, tmp_path: Path) -> None:
    with pytest.raises(km.errors.LogError, match=text):
        km.load_model(edited(saved, tmp_path / "hostile.npz", change))


def test_a_file_without_its_text(tmp_path: Path) -> None:
    np.savez(tmp_path / "data.npz", X=np.zeros(3))
    with pytest.raises(
        km.errors.LogError, match=r"it is of another program: it holds X, and lacks tree; pass the \.npz"
    ):
        km.load_model(tmp_path / "data.npz")
    np.savez(tmp_path / "data.npz", tree=np.frombuffer(b"no json", dtype=np.uint8))
    with pytest.raises(km.errors.LogError, match=r"is damaged: the text in it cannot be read; pass the \.npz"):
        km.load_model(tmp_path / "data.npz")


def test_a_file_holds_a_tree_and_arrays_and_nothing_else(saved: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(saved.read_bytes())) as file:
        names = set(file.namelist())
    assert names == {"tree.npy", *(f"array{i}.npy" for i in range(len(names) - 1))}
