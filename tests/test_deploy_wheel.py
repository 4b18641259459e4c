"""The controller alone: its wheel's contents, and the wheel installed on a bare Python, where it starts and checks."""

from __future__ import annotations

import base64
import contextlib
import csv
import hashlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from email.parser import Parser
from pathlib import Path

import pytest

from firmware_py.errors import UserError as FirmwareError
from sim.errors import UserError
from tools.deploy import wheel
from tools.deploy.wheel import build_wheel

ROOT = Path(__file__).resolve().parent.parent
ALLOWED = {"python-can", "cantools", "numpy"}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


def read(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


def test_it_holds_the_controller_the_contract_and_the_tables_and_nothing_else(built: Path) -> None:
    contents = read(built)
    tracked = subprocess.run(
        ["git", "ls-files", "firmware_py", "dbc"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    names = {name for name in contents if not name.startswith("parkctl_controller-")}
    assert {"firmware_py/__main__.py", "firmware_py/core/gate.py", "firmware_py/dbc/parking.dbc"} <= names
    assert {"firmware_py/dbc/vehicles/paper.toml", "firmware_py/tables/paper-ohio/path.csv"} <= names
    if tracked.returncode == 0:  # a source tree without git has no list to compare with
        wanted = {name if name.startswith("firmware_py") else f"firmware_py/{name}" for name in tracked.stdout.split()}
        assert wanted - names == set()
    assert {name.partition("/")[0] for name in names} == {"firmware_py"}
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


def test_its_metadata_names_three_packages(built: Path) -> None:
    contents = read(built)
    metadata = Parser().parsestr(contents["parkctl_controller-0.1.0.dist-info/METADATA"].decode())
    assert set(metadata.get_all("Requires-Dist")) == ALLOWED
    assert (metadata["Name"], metadata["Requires-Python"]) == ("parkctl-controller", ">=3.11")


def test_its_record_is_right(built: Path) -> None:
    contents = read(built)
    rows = list(csv.reader(io.StringIO(contents["parkctl_controller-0.1.0.dist-info/RECORD"].decode())))
    assert [row[0] for row in rows] == list(contents)
    for name, digest, size in rows[:-1]:
        sha = base64.urlsafe_b64encode(hashlib.sha256(contents[name]).digest()).rstrip(b"=").decode()
        assert (digest, size) == (f"sha256={sha}", str(len(contents[name])))


def test_equal_sources_give_equal_bytes(built: Path, tmp_path: Path) -> None:
    assert build_wheel(tmp_path).read_bytes() == built.read_bytes()


def test_a_folder_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"--out .*file/x: cannot be written \(Not a directory\)"):
        build_wheel(tmp_path / "file" / "x")


def test_an_installed_parkctl_without_its_sources_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(wheel, "ROOT", tmp_path)
    with pytest.raises(UserError, match="a wheel is built from a source tree"):
        build_wheel(tmp_path / "out")
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1"\n')
    with pytest.raises(UserError, match="firmware_py: missing; a wheel is built from a source tree"):
        build_wheel(tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not issubclass(FirmwareError, UserError), "the tool raises its own"


# ---------------------------------------------------------------------------------------------------- on a bare Python


@pytest.fixture(scope="module")
def python(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a virtual environment that holds the wheel and what it asks for."""
    folder = tmp_path_factory.mktemp("car") / "venv"
    venv.create(folder, with_pip=False, symlinks=True)
    interpreter = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(interpreter), "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "install", "--quiet", "--no-compile", "-c", str(ROOT / "constraints.txt"), str(built)],
        check=True,
        timeout=300,
    )
    return interpreter


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "CAN_", "VIRTUAL_ENV"))}


def run(python: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(python), *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment(), timeout=60, check=False
    )


@contextlib.contextmanager
def controller(python: Path, folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [str(python), "-P", "-m", "firmware_py", "-i", "virtual", "-c", "car", "--no-config", *options]
    child = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, env=environment()
    )
    try:
        yield child
    finally:
        child.kill()
        child.communicate()


@pytest.mark.live
def test_what_is_installed_is_what_a_car_needs(python: Path, tmp_path: Path) -> None:
    code = (
        "import importlib.metadata as m, json, pathlib, sys\n"
        "print(json.dumps([sorted(d.name for d in m.distributions()), sys.prefix]))"
    )
    names, prefix = json.loads(run(python, tmp_path, "-c", code).stdout)
    direct = {"parkctl-controller", *ALLOWED}
    assert direct <= set(names)
    assert not {"parkctl", "pydantic", "rich", "scipy", "control", "matplotlib", "numba"} & set(names)
    assert (Path(prefix) / "share/parkctl/parkctl-controller@.service").is_file()
    assert os.access(Path(prefix) / "bin/parkctl-can-up", os.X_OK)


@pytest.mark.live
@pytest.mark.parametrize("options", [[], ["--listen-only", "--side", "right", "--law", "pid+ff"]])
def test_it_starts_on_a_bare_python(python: Path, tmp_path: Path, options: list[str]) -> None:
    with controller(python, tmp_path, "--status", "--out", str(tmp_path), *options) as child:
        assert child.stdout is not None
        first = json.loads(child.stdout.readline())
        resident = re.findall(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{child.pid}/status").read_text())
        child.send_signal(signal.SIGTERM)
        out, error = child.communicate(timeout=20)
    assert child.returncode == 0, error
    assert first["reason_text"].startswith("waiting for reports")
    assert re.fullmatch(
        r"controller on .*: (SCHED_FIFO 80, .*, gc frozen(; listening only, nothing is sent)?|normal priority: .*)\n",
        error,
    )
    final = json.loads(out.splitlines()[-1])["final"]
    assert list(final["realtime"]) == ["timer_slack", "cpu", "memory", "cpu_dma_latency", "gc", "scheduler"]
    assert (tmp_path / "flight_record.csv").is_file()
    assert int(resident[0]) < 60 * 1024, "the memory that a car's computer is promised, KiB"


@pytest.mark.live
def test_its_preflight_checks_there_too(python: Path, tmp_path: Path) -> None:
    answer = run(
        python, tmp_path, "-P", "-m", "firmware_py", "--preflight", "-i", "virtual", "-c", "car", "--no-config"
    )
    assert answer.returncode == 1, answer.stderr
    assert answer.stderr == ""
    lines = answer.stdout.splitlines()
    assert len(lines) == 21
    assert [line.split()[0] for line in lines[1:5]] == ["ok"] * 4
    assert "VEH_SysRpt     never heard" in answer.stdout
    assert lines[-1].startswith("preflight: 7 of 19 passed; do not arm: ")


@pytest.mark.live
def test_the_emulators_bus_is_not_there_and_that_is_said(python: Path, tmp_path: Path) -> None:
    answer = run(python, tmp_path, "-P", "-m", "firmware_py", "--no-config")
    assert answer.returncode == 2
    assert answer.stderr == (
        "parkctl: error: CAN interface loopbus: cannot be opened (the embedded bus comes with the emulator and is not "
        "installed here; name a bus, as in -i socketcan)\n"
    )
