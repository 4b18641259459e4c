"""The emulated machine with CAN cards, as far as it can be judged without booting it; and slow motion."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_py.__main__ import main as controller_main
from firmware_py.loop import Clock
from sim.errors import UserError
from tools import cli
from tools.guest import hardware, image

ROOT = Path(__file__).resolve().parent.parent


def complaint(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_without_qemu_or_its_kernel_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(image.FOLDER_VARIABLE, str(tmp_path / "guest"))
    monkeypatch.setenv("PATH", str(tmp_path))
    for arguments in (["--", "true"], ["--install"]):
        assert "apt-get install --no-install-recommends qemu-system-x86" in complaint(
            ["guest", "--hardware", *arguments], capsys
        )
    (tmp_path / hardware.QEMU).write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / hardware.QEMU).chmod(0o755)
    said = complaint(["guest", "--hardware", "--", "true"], capsys)
    assert "parkctl guest --hardware --install" in said
    assert "guest-hardware/vmlinuz" in said


def test_a_machine_that_ends_by_itself_is_told_with_what_qemu_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(image.FOLDER_VARIABLE, str(tmp_path / "guest"))
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / hardware.QEMU).write_text("#!/bin/sh\necho 'qemu: no memory' >&2\nexit 1\n")
    (tmp_path / hardware.QEMU).chmod(0o755)
    hardware.machine_folder().mkdir(parents=True)
    for name in ("vmlinuz", "busybox", *(Path(module).name for module in hardware.MODULES)):
        (hardware.machine_folder() / name).write_bytes(b"x")
    before = set(tmp_path.parent.iterdir())
    with pytest.raises(UserError, match="the machine did not finish: qemu: no memory"):
        hardware.run_in_machine(["true"], [tmp_path])
    assert set(tmp_path.parent.iterdir()) == before


def test_the_first_file_system_is_an_archive_that_others_can_read() -> None:
    content = bytes(range(256)) * 3
    archive = hardware.cpio([("bin", 0o040755, b""), ("bin/tool", 0o100755, content), ("init", 0o120777, b"bin/tool")])
    assert len(archive) % 4 == 0
    found, at = {}, 0
    while True:
        assert archive[at : at + 6] == b"070701"
        numbers = [int(archive[at + 6 + 8 * i : at + 14 + 8 * i], 16) for i in range(13)]
        mode, size, name_size = numbers[1], numbers[6], numbers[11]
        name = archive[at + 110 : at + 110 + name_size - 1].decode()
        start = -(-(at + 110 + name_size) // 4) * 4
        if name == "TRAILER!!!":
            break
        found[name] = (mode, archive[start : start + size])
        at = -(-(start + size) // 4) * 4
    assert found == {"bin": (0o040755, b""), "bin/tool": (0o100755, content), "init": (0o120777, b"bin/tool")}


# -------------------------------------------------------------------------------------------------------- slow motion


def test_the_loops_time_passes_slower_by_the_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = 7_000_000_000
    slept_s: list[float] = []
    monkeypatch.setattr("firmware_py.loop.time.monotonic_ns", lambda: now_ns)
    monkeypatch.setattr("firmware_py.loop.time.sleep", slept_s.append)
    clock = Clock(20)
    assert clock.now_ns() == 350_000_000
    clock.sleep(0.01)
    assert slept_s == [0.2]


@pytest.mark.parametrize("factor", ["0", "1001", "-1"])
def test_a_scale_that_makes_no_sense_is_refused_by_all_three(factor: str, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = f"--slow-motion {factor}: must be from 1 to 1000"
    assert controller_main([f"--slow-motion={factor}"]) == 2
    assert wanted in capsys.readouterr().err
    assert wanted in complaint(["operate", "--auto", f"--slow-motion={factor}"], capsys)
    car = subprocess.run(
        [sys.executable, "-P", "-m", "sim", f"--slow-motion={factor}"],
        capture_output=True, text=True, check=False, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert car.returncode == 2
    assert wanted in car.stderr


def test_a_car_is_not_checked_in_slow_motion(capsys: pytest.CaptureFixture[str]) -> None:
    assert controller_main(["--preflight", "--slow-motion", "2"]) == 2
    assert "a car is not checked in slow motion" in capsys.readouterr().err


@pytest.mark.live
def test_car_and_controller_agree_on_slow_motion(tmp_path: Path) -> None:
    """At half speed for six seconds: both saw half of them, and the controller sees each report at its cycle time."""
    common = ["-c", "28690", "--slow-motion", "2", "--status"]
    car = subprocess.Popen(
        [sys.executable, "-P", "-m", "sim", *common, "--duration", "5"], stdout=subprocess.PIPE, cwd=ROOT
    )
    controller = subprocess.Popen(
        [sys.executable, "-P", "-m", "firmware_py", *common, "--no-config"],
        stdout=(tmp_path / "said").open("wb"), cwd=ROOT,
    )  # fmt: skip
    try:
        said = car.communicate(timeout=60)[0].splitlines()
    finally:
        controller.terminate()
        controller.wait(20)
    assert 4.5 < json.loads(said[-1])["t_s"] <= 5.0
    final = json.loads((tmp_path / "said").read_text().splitlines()[-1])["final"]
    assert (final["frames_lost"], final["frames_rejected"], final["held_reports"]) == (0, 0, [])
    assert final["cycles"] > 300
    assert 4.0 < final["frames_received"] / final["cycles"] < 6.7, "six reports a cycle while the car was there"
