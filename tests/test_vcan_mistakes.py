"""Mistakes in calling the guest: one line each, and nothing is booted."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim.errors import UserError
from tools import cli
from tools.guest import image


def complaint(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert cli.main(["guest", *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_no_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert "name the command to run" in complaint([], capsys)


def test_a_guest_that_is_not_installed_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(image.FOLDER_VARIABLE, str(tmp_path / "nothing"))
    said = complaint(["--", "true"], capsys)
    assert "linux.uml" in said
    assert "parkctl guest --install" in said
    monkeypatch.setattr(image.platform, "machine", lambda: "aarch64")
    assert "Linux on x86-64, and this is Linux on aarch64" in complaint(["--", "true"], capsys)


def test_a_guest_in_a_guest(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PARKCTL_IN_GUEST", "1")
    assert "this is the guest already" in complaint(["--", "true"], capsys)


def test_an_install_without_apt_names_the_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv(image.FOLDER_VARIABLE, str(tmp_path / "guest"))
    assert "user-mode-linux, busybox-static, can-utils" in complaint(["--install"], capsys)
    assert not (tmp_path / "guest").exists()


def test_an_install_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("apt-get", "dpkg-deb"):
        (tmp_path / name).write_text("#!/bin/sh\necho 'E: Unable to locate package can-utils' >&2\nexit 100\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv(image.FOLDER_VARIABLE, str(tmp_path / "cache/guest"))
    with pytest.raises(UserError, match=r"apt-get download: E: Unable to locate package can-utils \(is the list"):
        image.install()
    assert list((tmp_path / "cache").iterdir()) == []
