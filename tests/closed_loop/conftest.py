"""The table of the closed loops is printed at the end of a run, whichever process measured it."""


def pytest_terminal_summary(terminalreporter):
    reports = [*terminalreporter.stats.get("passed", []), *terminalreporter.stats.get("failed", [])]
    tables = [value for report in reports for name, value in report.user_properties if name == "closed loops"]
    for table in tables:
        terminalreporter.write_line(table)
