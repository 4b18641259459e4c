"""The walls of the architecture, checked on every import in the source and on what live processes have loaded."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
STDLIB = sys.stdlib_module_names
# What makes a second thread in the vehicle's process: the interpreter lock knows no priorities.
THREADS = {"threading", "_thread", "concurrent", "asyncio", "multiprocessing", "queue"}
CLOCKS = {"time", "datetime", "timeit", "sched"}


def imported(source: str) -> set[str]:
    """Return the dotted names of all modules that a source text imports, `from a import b` as `a` and `a.b`."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import: the walls are checked on absolute names"
            names.add(node.module or "")
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in {"import_module", "__import__"}:
                names.add(ast.literal_eval(node.args[0]) if isinstance(node.args[0], ast.Constant) else "?dynamic")
    return names


def top(names: set[str]) -> set[str]:
    return {name.partition(".")[0] for name in names}


def sources(folder: str) -> list[Path]:
    found = sorted((ROOT / folder).rglob("*.py"))
    assert found, f"no sources in {folder}"
    return found


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def tree() -> Iterator[Path]:
    """Return the text files that belong to the project: what git tracks, or all but the hidden and the generated."""
    listing = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        capture_output=True,
        check=False,
    )
    if listing.returncode == 0:
        names = [Path(os.fsdecode(name)) for name in listing.stdout.split(b"\0") if name]
    else:
        hidden = {".venv", ".git", "runs", "build", "dist"}
        names = [path.relative_to(ROOT) for path in ROOT.rglob("*") if not hidden & set(path.relative_to(ROOT).parts)]
    yield from (ROOT / name for name in names if (ROOT / name).is_file())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import scipy.optimize as o", "scipy"),
        ("def f():\n    from numba import njit", "numba"),
        ("import importlib\nimportlib.import_module('sim.emulator')", "sim"),
        ("__import__('control')", "control"),
        ("import importlib\nname = 'x'\nimportlib.import_module(name)", "?dynamic"),
    ],
)
def test_the_import_finder_sees_every_way_of_importing(text: str, expected: str) -> None:
    assert expected in top(imported(text))


@pytest.mark.parametrize("path", sources("firmware_py"), ids=relative)
def test_firmware_imports_only_what_sits_in_the_car(path: Path) -> None:
    names = top(imported(path.read_text()))
    allowed = STDLIB | {"firmware_py", "numpy"}
    allowed |= {"can"} if path.name == "bus.py" else set()
    allowed |= {"cantools"} if path.name == "codec.py" else set()
    assert names <= allowed, f"{relative(path)} imports {sorted(names - allowed)}"
    assert not names & THREADS, f"{relative(path)}: no second thread in the vehicle's process"
    if path.name != "loop.py":
        assert not names & CLOCKS, f"{relative(path)}: only loop.py reads a clock; now_ns is handed down"


@pytest.mark.parametrize("path", sources("firmware_py/core"), ids=relative)
def test_the_core_imports_only_math_and_typing(path: Path) -> None:
    """`collections.abc` is where the types live that typing no longer has of its own."""
    names = {name for name in imported(path.read_text()) if not name.startswith("collections.abc")}
    foreign = {name for name in names if top({name}) - {"math", "typing"} and not name.startswith("firmware_py.core")}
    assert not foreign, f"{relative(path)} imports {sorted(foreign)}"


@pytest.mark.parametrize("path", sources("sim"), ids=relative)
def test_the_plant_knows_neither_firmware_nor_tools(path: Path) -> None:
    names = top(imported(path.read_text()))
    allowed = STDLIB | {"sim", "can", "cantools", "crccheck", "numpy", "pydantic"}
    assert names <= allowed, f"{relative(path)} imports {sorted(names - allowed)}"
    if path.name not in {"__main__.py", "loopbus.py"}:
        assert not names & CLOCKS, f"{relative(path)}: only sim/__main__.py reads a clock; now_ns is handed down"


def test_the_embedded_bus_stands_alone() -> None:
    """The vehicle's process loads sim/loopbus.py through its entry point, and sim/__init__.py with it; nothing else."""
    assert (ROOT / "sim/__init__.py").read_text() == ""
    names = top(imported((ROOT / "sim/loopbus.py").read_text()))
    assert names <= STDLIB | {"can"}, sorted(names)


@pytest.mark.parametrize("path", sources("tools"), ids=relative)
def test_matplotlib_and_the_plants_process_have_one_door_each(path: Path) -> None:
    names = imported(path.read_text())
    if path.parent != ROOT / "tools/plots":
        assert "matplotlib" not in top(names), f"{relative(path)}: pictures are made by tools/plots"
    if relative(path) != "tools/lockstep.py":
        assert "sim.emulator" not in names, f"{relative(path)}: controller and plant meet in tools/lockstep.py only"


def test_dbc_is_data_only() -> None:
    assert (ROOT / "dbc/parking.dbc").is_file()
    assert not list((ROOT / "dbc").rglob("*.py"))


def modules_after(code: str) -> set[str]:
    """Return the names of all modules that a fresh interpreter holds after running the code."""
    answer = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys\nprint('\\n'.join(['MODULES', *sys.modules]))"],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
    )
    assert answer.returncode == 0, answer.stderr
    return set(answer.stdout.partition("MODULES\n")[2].split())


def test_the_plants_process_cannot_load_the_firmware() -> None:
    """The bulkhead in sim/__main__.py makes any later import of the firmware fail."""
    loaded = modules_after(
        "import sim.__main__, sim.emulator, sys\n"
        "assert sys.modules['firmware_py'] is None\n"
        "try:\n    import firmware_py.core.signals\n"
        "except ImportError:\n    pass\n"
        "else:\n    raise SystemExit('the firmware could be imported')"
    )
    assert "sim.emulator" in loaded
    assert not {"tools", "scipy", "control", "matplotlib", "numba"} & top(loaded)


def test_the_vehicles_process_loads_no_design_tools() -> None:
    """With the DBC read, its codec generated and the embedded bus open, only the bus of sim is there."""
    loaded = modules_after(
        "import firmware_py.__main__\n"
        "from pathlib import Path\n"
        "from firmware_py.codec import load_codec\n"
        "load_codec(Path('dbc/parking.dbc'))\n"
        "import can\n"
        "can.Bus(interface='loopbus', channel='28940', ignore_config=True).shutdown()"
    )
    assert {"firmware_py.loop", "firmware_py.core", "sim.loopbus"} <= loaded
    assert not {"tools", "scipy", "control", "matplotlib", "numba", "pydantic", "rich"} & top(loaded)
    assert {name for name in loaded if name.partition(".")[0] == "sim"} == {"sim", "sim.loopbus"}


def test_the_command_line_loads_only_what_a_subcommand_needs() -> None:
    loaded = modules_after("import tools.cli\ntry:\n    tools.cli.main(['--help'])\nexcept SystemExit:\n    pass")
    assert "tools.cli" in loaded
    heavy = {"numpy", "scipy", "control", "matplotlib", "numba", "can", "cantools", "pydantic", "rich"}
    assert not heavy & top(loaded), sorted(heavy & top(loaded))


def test_no_download_address_stands_in_the_tree() -> None:
    """Where packages come from is the business of the machine, not of the project."""
    hosts = ["py" + "pi.org", "python" + "hosted.org", "ana" + "conda.org", "deb." + "debian.org", "index-" + "url"]
    hosts += ["find-" + "links", "archive." + "ubuntu.com", "npm" + "js."]
    found = []
    for path in tree():
        text = path.read_text(encoding="utf-8", errors="ignore").lower()
        found += [f"{relative(path)}: {host}" for host in hosts if host in text]
    assert not found


def test_constraints_pin_every_package_exactly() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert len(lines) > 20
    loose = [line for line in lines if line.count("==") != 1 or any(mark in line for mark in "/@ ;")]
    assert not loose
