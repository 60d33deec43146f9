"""drawable: what the viewer's font holds stays, what it lacks is spelled otherwise."""

from hypothesis import given, settings
from hypothesis import strategies as st

from koopmpc.recording.description import drawable


def test_what_the_font_holds_stays_as_it_is() -> None:
    text = "θ̇ [rad/s], x̂ − Φ⁺ψ(x₁) ≤ 10⁻⁴ √2 · ‖x‖ Жč\n| a | – |"
    assert drawable(text) == text


def test_what_it_lacks_is_spelled_otherwise() -> None:
    assert drawable("Uᵀ𝜓 ∈ ℝ") == "U^Tψ  in  R"
    assert drawable("位置 [m] 😀") == "?? [m] ?"


@settings(max_examples=40, deadline=None)
@given(text=st.text())
def test_drawn_text_is_drawn_as_it_is(text: str) -> None:
    once = drawable(text)
    assert drawable(once) == once
