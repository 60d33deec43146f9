"""`make speed`: benchmarks of what users run, without the type hook, and one table of figures at the end."""

import os

import pytest


@pytest.fixture(autouse=True)
def without_the_type_hook():
    if os.environ.get("KOOPMPC_TESTS") != "bare":
        pytest.fail("checks are on and would be measured; run `make speed`")


def pytest_terminal_summary(terminalreporter, config):
    session = getattr(config, "_benchmarksession", None)
    rows = [
        (bench.name.removeprefix("test_"), figure, value)
        for bench in (session.benchmarks if session else ())
        for figure, value in bench.extra_info.items()
    ]
    if rows:
        terminalreporter.section("figures")
    for name, figure, value in rows:
        text = f"{value:.4g}" if isinstance(value, float | int) else str(value)
        terminalreporter.write_line(f"{name:<55} {figure:<40} {text}")
