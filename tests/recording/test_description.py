"""The description of a run is exact data and a page to read, in signs that the viewer's font has."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from koopmpc.loop.run import About
from koopmpc.recording.description import drawable, from_json, to_json, to_markdown
from tests.recording.runs import make_run


def test_what_the_font_holds_stays_as_it_is() -> None:
    text = "θ̇ [rad/s], x̂ − Φ⁺ψ(x₁) ≤ 10⁻⁴ √2 · ‖x‖ Жč\n| a | – |"
    assert drawable(text) == text


def test_what_the_font_lacks_is_spelled_otherwise() -> None:
    assert drawable("Uᵀ𝜓 ∈ ℝ") == "U^Tψ  in  R"
    assert drawable("位置 [m] 😀") == "?? [m] ?"


@settings(max_examples=40, deadline=None)
@given(text=st.text())
def test_text_that_can_be_drawn_is_left_alone(text: str) -> None:
    once = drawable(text)
    assert drawable(once) == once


def test_the_description_says_what_ran_and_with_what() -> None:
    told = {
        "problem": "pendulum",
        "case": "upright",
        "controller": "lqr",
        "seed": 7,
        "versions": {"casadi": "9.9"},
    }
    page = to_markdown(About(**make_run(metadata=told).about()))
    assert page.startswith("# pendulum · upright · lqr")
    for part in (
        "| seed | 7 |",
        "casadi 9.9",
        "| u_max | [",
        "state 0 [m]",
        "written with",
        "rerun-sdk 0.41",
    ):
        assert part in page


def test_the_description_is_exact_data() -> None:
    run = make_run(metadata={"a": [1, 2.5, None], "b": {"c": float("nan")}, "d": np.arange(3.0)})
    about, steps = from_json(to_json(About(**run.about()), 20))
    assert about == About(**run.about())
    assert steps == 20
