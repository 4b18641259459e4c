"""What the guest is made of: three Debian packages, unpacked into a cache; nothing is installed, no root is needed."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from sim.errors import UserError

FOLDER_VARIABLE = "PARKCTL_GUEST"
PACKAGES = ("user-mode-linux", "busybox-static", "can-utils")
MODULES = (
    "drivers/net/can/dev/can-dev.ko", "net/can/can.ko", "net/can/can-raw.ko", "net/can/can-bcm.ko",
    "net/can/can-gw.ko", "drivers/net/can/vcan.ko", "drivers/net/can/vxcan.ko", "drivers/net/can/slcan/slcan.ko",
)  # fmt: skip
"""Loaded in this order: each needs the ones before it."""
CAN_TOOLS = (
    "candump", "cansend", "cangen", "canplayer", "cansniffer", "canbusload", "cangw", "cansequence", "canfdtest",
    "log2asc", "asc2log", "log2long", "slcand", "slcan_attach", "slcanpty",
)  # fmt: skip
HOW_TO_INSTALL = "parkctl guest --install fetches it (Debian or Ubuntu on x86-64; 42 MB, no root needed)"


class Image(NamedTuple):
    """Where the parts of the guest lie: `tools` holds can-utils, `modules` the kernel modules in loading order."""

    kernel: Path
    busybox: Path
    tools: Path
    modules: tuple[Path, ...]


def image_folder() -> Path:
    """Return the folder of the guest's parts: $PARKCTL_GUEST, else parkctl/guest in the user's cache."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named).absolute()
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache and Path(cache).is_absolute() else Path.home() / ".cache") / "parkctl" / "guest"


def _image_in(folder: Path) -> Image:
    return Image(
        kernel=folder / "linux.uml",
        busybox=folder / "busybox",
        tools=folder / "can-utils",
        modules=tuple(folder / "modules" / Path(module).name for module in MODULES),
    )


def why_not() -> str | None:
    """Return in one line why the guest cannot be started here, None where all its parts are there."""
    if sys.platform != "linux" or platform.machine() not in {"x86_64", "AMD64"}:
        return f"the guest is Linux on x86-64, and this is {platform.system()} on {platform.machine()}"
    image = _image_in(image_folder())
    parts = (image.kernel, image.busybox, *image.modules, *(image.tools / tool for tool in CAN_TOOLS))
    missing = [part for part in parts if not part.is_file()]
    if not missing:
        return None
    return f"the guest is not there ({missing[0]}); {HOW_TO_INSTALL}"


def find_image() -> Image:
    """Return the parts of the guest. Raises UserError where one is missing."""
    reason = why_not()
    if reason is not None:
        raise UserError(reason)
    return _image_in(image_folder())


def install() -> Path:
    """Fetch the packages and unpack them into the cache, all or nothing; return the folder. Raises UserError."""
    for program in ("apt-get", "dpkg-deb"):
        if shutil.which(program) is None:
            raise UserError(
                f"guest --install: {program} is not there; unpack Debian's packages {', '.join(PACKAGES)} on another "
                f"machine with it and copy its folder {image_folder()}"
            )
    folder = image_folder()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".guest-") as made:
            Path(made).chmod(0o755)  # apt may fetch as a user of its own
            new = _unpack(Path(made))
            old = Path(made) / "old"
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
    except OSError as error:
        raise UserError(f"guest --install: {folder}: {error.strerror}") from None
    return folder


def _unpack(work: Path) -> Path:
    """Fetch into `work` and sort the parts out of the packages; return their folder."""
    packages, root, new = work / "packages", work / "root", work / "new"
    for path in (packages, root, new / "modules", new / "can-utils"):
        path.mkdir(parents=True)
    run_apt(["apt-get", "download", "-qq", *PACKAGES], packages)
    for package in sorted(packages.glob("*.deb")):
        run_apt(["dpkg-deb", "-x", str(package), str(root)], packages)
    (root / "usr/bin/linux.uml").rename(new / "linux.uml")
    (root / "bin/busybox").rename(new / "busybox")
    for tool in CAN_TOOLS:
        (root / "usr/bin" / tool).rename(new / "can-utils" / tool)
    kernels = sorted(root.glob("usr/lib/uml/modules/*/kernel"))
    for module in MODULES:
        (kernels[-1] / module).rename(new / "modules" / Path(module).name)
    versions = "".join(f"{package.name}\n" for package in sorted(packages.glob("*.deb")))
    (new / "packages.txt").write_text(versions, encoding="utf-8")
    return new


def run_apt(command: list[str], folder: Path) -> None:
    """Run a program of apt or dpkg in a folder. Raises UserError with what it complained of."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        said = [line.strip() for line in (done.stderr + done.stdout).splitlines() if line.startswith(("E:", "dpkg"))]
        why = said[-1] if said else f"status {done.returncode}"
        hint = " (is the list of packages there? apt-get update)" if command[0] == "apt-get" else ""
        raise UserError(f"guest --install: {' '.join(command[:2])}: {why}{hint}")
