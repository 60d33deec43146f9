"""plan_further plans by a model of its own where that of a design bears no plan."""

import numpy as np

import koopmpc as km
from koopmpc.fitting import further
from koopmpc.synthesis.designed import Design
from tests.fitting.mass import logs


def test_where_the_model_of_a_design_bears_no_plan_another_is_fitted(tmp_path, monkeypatch):
    def plan(*args, design, **more):
        if design is not None:
            raise km.errors.DataError("no safe plan exists: the band of this design")
        return km.next_experiment(*args, **more)

    monkeypatch.setattr(further, "next_experiment", plan)
    call = {"horizon": 15, "steps": 40, "file": tmp_path / "plan.csv"}
    task = km.Cost(Q=[1, 0.1], R=0.01), km.Limits(u_min=-2, u_max=2, x_min=[-np.inf, -0.8], x_max=[np.inf, 0.8])
    made = further.plan_further(logs(4), *task, np.array([0.5, 0.0]), design=object.__new__(Design), **call)
    assert made.plan is not None
    refused = further.plan_further(logs(4), *task, np.array([9.0, 0.0, 0.0]), design=object.__new__(Design), **call)
    assert refused.plan is None
    assert "this design" not in refused.sentence
