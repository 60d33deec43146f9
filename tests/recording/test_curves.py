"""record_curves: what is written can be read, and what would end the viewer is not written."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.recording.views.curves import Curves, record_curves


def written(path):
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.split(":")[-1] in ("scalars", "text"):
                found.setdefault(chunk.entity_path, []).extend(batch.column(name).to_pylist())
    return found


def test_curves_come_back_and_gaps_stay_gaps(tmp_path):
    truth = np.arange(10.0).reshape(5, 2)
    holed = truth + 0.5
    holed[1, 0] = np.nan
    holed[:, 1] = np.nan  # no entity at all: a timeline without a row ends the viewer
    tab = Curves("one, two", 0.1, ("x [m]", "v [m/s]"), {"truth": truth, "model a": holed})
    record_curves([tab], tmp_path / "deep" / "c.rrd", application="koopmpc-test", page="# Uᵀ")
    found = written(tmp_path / "deep" / "c.rrd")
    flat = {entity: [row[0] for row in rows] for entity, rows in found.items()}
    assert flat["/one_two/x_m/0_truth"] == truth[:, 0].tolist()
    assert flat["/one_two/x_m/1_model_a"] == [0.5, 4.5, 6.5, 8.5]
    assert flat["/one_two/v_m_s/0_truth"] == truth[:, 1].tolist()
    assert "/one_two/v_m_s/1_model_a" not in flat
    assert flat["/page"] == ["# U^T"]


TAB = Curves("one", 0.1, ("x",), {"truth": np.zeros((3, 1))})
WIDE = Curves("one", 0.1, ("x", "y"), {"truth": np.zeros((3, 1))})


@pytest.mark.parametrize(
    ("error", "text", "tabs"),
    [
        (km.errors.DataError, r"there is no curve to record", []),
        (km.errors.DataError, r"two tabs are called 'one'", [TAB, TAB]),
        (km.errors.ShapeError, r"truth has shape \(3, 1\), expected \(any, 2\)", [WIDE]),
    ],
)
def test_curves_that_cannot_be_drawn_are_named(tmp_path, error, text, tabs):
    with pytest.raises(error, match=text):
        record_curves(tabs, tmp_path / "c.rrd", application="koopmpc-test", page="")
