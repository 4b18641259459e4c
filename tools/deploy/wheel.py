"""The wheel of the controller alone: firmware_py, dbc and tables; python-can, cantools and numpy are all it needs.

Written directly, not by a build tool: nothing is downloaded, and equal sources give equal bytes, so that the hash of
the file says what is in the car. The folder `dbc` goes into the package; `python -m firmware_py` finds it there.
Format: PyPA specification "Binary distribution format" 1.0.
"""

from __future__ import annotations

import base64
import hashlib
import os
import tomllib
import zipfile
from pathlib import Path

from sim.errors import UserError

ROOT = Path(__file__).resolve().parent.parent.parent
HERE = Path(__file__).resolve().parent

NAME = "parkctl_controller"
DEPENDENCIES = ("python-can", "cantools", "numpy")
SUFFIXES = {".py", ".toml", ".csv", ".dbc", ".md"}

SCRIPTS = {"parkctl-can-up": HERE / "can_up.sh"}
SHARED = ("parkctl-can@.service", "parkctl-controller@.service", "controller.env")
"""Files that land in PREFIX/share/parkctl."""

_EARLIEST = (1980, 1, 1, 0, 0, 0)
"""The time of every file in the archive: the earliest that the format knows."""


def build_wheel(folder: Path) -> Path:
    """Write the wheel into the folder, whole or not at all; return its path. Errors: UserError."""
    try:
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        contents = wheel_contents(project)
    except OSError as error:
        raise UserError(
            f"{error.filename}: cannot be read ({error.strerror}); a wheel is built from a source tree"
        ) from None
    file = folder / f"{NAME}-{project['version']}-py3-none-any.whl"
    temporary = file.with_name(file.name + ".part")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in contents.items():
                entry = zipfile.ZipInfo(name, _EARLIEST)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = (0o100755 if ".data/scripts/" in name else 0o100644) << 16
                archive.writestr(entry, content)
        os.replace(temporary, file)
    except OSError as error:
        raise UserError(f"--out {folder}: cannot be written ({error.strerror})") from None
    return file


def wheel_contents(project: dict[str, str]) -> dict[str, bytes]:
    """Return the files of the wheel by their names in it, the record of all others last."""
    stem = f"{NAME}-{project['version']}"
    contents = _tree(ROOT / "firmware_py", "firmware_py") | _tree(ROOT / "dbc", "firmware_py/dbc")
    contents |= {f"{stem}.data/scripts/{name}": source.read_bytes() for name, source in SCRIPTS.items()}
    contents |= {f"{stem}.data/data/share/parkctl/{name}": (HERE / name).read_bytes() for name in SHARED}
    contents[f"{stem}.dist-info/METADATA"] = _metadata(project).encode()
    contents[f"{stem}.dist-info/WHEEL"] = (
        b"Wheel-Version: 1.0\nGenerator: parkctl deploy\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    contents[f"{stem}.dist-info/top_level.txt"] = b"firmware_py\n"
    record = f"{stem}.dist-info/RECORD"
    lines = [f"{name},sha256={_digest(content)},{len(content)}" for name, content in contents.items()]
    contents[record] = ("\n".join([*lines, f"{record},,"]) + "\n").encode()
    return contents


def _tree(folder: Path, name: str) -> dict[str, bytes]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix in SUFFIXES)
    if not files:
        raise UserError(f"{folder}: missing; a wheel is built from a source tree")
    return {f"{name}/{path.relative_to(folder).as_posix()}": path.read_bytes() for path in files}


def _metadata(project: dict[str, str]) -> str:
    lines = [
        "Metadata-Version: 2.1",
        f"Name: {NAME.replace('_', '-')}",
        f"Version: {project['version']}",
        "Summary: The parking controller of parkctl, as it sits in the car: python -m firmware_py",
        f"Requires-Python: {project['requires-python']}",
        *(f"Requires-Dist: {name}" for name in DEPENDENCIES),
    ]
    return "\n".join(lines) + "\n"


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
