"""What holds for all tests."""

from __future__ import annotations

import os
import signal

import pytest

# As in tools/cli.py: small matrices, and the test workers share the cores already.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Started in a shell's background, Ctrl-C is ignored, and so it would be by every process that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """On the build server a skipped test is a failed one: there everything is installed."""
    if os.environ.get("CI") != "true":
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and reporter.stats.get("skipped"):
        reporter.write_line(f"{len(reporter.stats['skipped'])} skipped, and CI=true allows none", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
