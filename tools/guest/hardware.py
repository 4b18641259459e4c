"""A whole emulated machine with two CAN cards on one bus: QEMU, Debian's kernel, the real sja1000/kvaser_pci driver.

Slower than the user-mode guest by far (every instruction is translated), so nothing in it keeps real time; what it adds
is the driver of a physical interface: bit rate, restart, state and statistics of can0 and can1. The machine's own
kernel is unpacked into a cache and nothing is installed; QEMU itself must be there.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from sim.errors import UserError
from tools.guest import image
from tools.guest.session import PROJECT, Outcome
from tools.processes import die_with_parent

QEMU = "qemu-system-x86_64"
HOW_TO_INSTALL = f"{QEMU} is not there (Debian and Ubuntu: apt-get install --no-install-recommends qemu-system-x86)"
KERNEL_PACKAGE = "linux-image-amd64"
"""Depends on the package that holds the newest kernel."""
MODULES = (
    "drivers/virtio/virtio_ring.ko", "drivers/virtio/virtio.ko", "drivers/virtio/virtio_pci_modern_dev.ko",
    "drivers/virtio/virtio_pci_legacy_dev.ko", "drivers/virtio/virtio_pci.ko", "fs/netfs/netfs.ko",
    "fs/fscache/fscache.ko", "net/9p/9pnet.ko", "net/9p/9pnet_virtio.ko", "fs/9p/9p.ko",
    "drivers/net/can/dev/can-dev.ko", "net/can/can.ko", "net/can/can-raw.ko", "drivers/net/can/sja1000/sja1000.ko",
    "drivers/net/can/sja1000/kvaser_pci.ko",
)  # fmt: skip
"""Loaded in this order: each needs the ones before it."""
APPLETS = ("sh", "mount", "mkdir", "insmod", "stty", "ip", "ln", "chroot", "sync", "poweroff")
INIT = Path(__file__).resolve().parent / "hardware_init.sh"
MEMORY_MB = 1024
BOOT_LIMIT_S = 120.0


def machine_folder() -> Path:
    """Return where kernel, modules and busybox of the machine lie: beside the user-mode guest."""
    return image.image_folder().with_name("guest-hardware")


def why_not() -> str | None:
    """Return in one line why the machine cannot be started here, None where all is there."""
    if sys.platform != "linux" or platform.machine() not in {"x86_64", "AMD64"}:
        return f"the machine is made for Linux on x86-64, and this is {platform.system()} on {platform.machine()}"
    if shutil.which(QEMU) is None:
        return HOW_TO_INSTALL
    folder = machine_folder()
    parts = [folder / "vmlinuz", folder / "busybox", *(folder / Path(module).name for module in MODULES)]
    missing = [part for part in parts if not part.is_file()]
    if not missing:
        return None
    return f"the machine's kernel is not there ({missing[0]}); parkctl guest --hardware --install fetches it (75 MB)"


def install() -> Path:
    """Fetch kernel and busybox with apt-get into the cache, all or nothing; return the folder. Raises UserError."""
    if shutil.which(QEMU) is None:
        raise UserError(f"guest --hardware: {HOW_TO_INSTALL}")
    for program in ("apt-get", "apt-cache", "dpkg-deb"):
        if shutil.which(program) is None:
            raise UserError(f"guest --hardware --install: {program} is not there; this needs Debian or Ubuntu")
    folder = machine_folder()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".guest-") as made:
            Path(made).chmod(0o755)  # apt may fetch as a user of its own
            new = _unpack(Path(made))
            if folder.exists():
                folder.rename(Path(made) / "old")
            new.rename(folder)
    except OSError as error:
        raise UserError(f"guest --hardware --install: {folder}: {error.strerror}") from None
    return folder


def _unpack(work: Path) -> Path:
    packages, root, new = work / "packages", work / "root", work / "new"
    for path in (packages, root, new):
        path.mkdir()
    asked = subprocess.run(
        ["apt-cache", "depends", "--important", KERNEL_PACKAGE], capture_output=True, text=True, check=False
    )
    kernels = [line.split()[-1] for line in asked.stdout.splitlines() if "Depends: linux-image-" in line]
    if not kernels:
        raise UserError(f"guest --hardware --install: no package {KERNEL_PACKAGE} (is the list there? apt-get update)")
    image.run_apt(["apt-get", "download", "-qq", kernels[0], "busybox-static"], packages)
    for package in sorted(packages.glob("*.deb")):
        image.run_apt(["dpkg-deb", "-x", str(package), str(root)], packages)
    next(iter(sorted((root / "boot").glob("vmlinuz-*")))).rename(new / "vmlinuz")
    (root / "bin/busybox").rename(new / "busybox")
    modules = next(iter(sorted(root.glob("lib/modules/*/kernel"))))
    for module in MODULES:
        (modules / module).rename(new / Path(module).name)
    (new / "packages.txt").write_text("".join(f"{p.name}\n" for p in sorted(packages.glob("*.deb"))), encoding="utf-8")
    return new


def run_in_machine(command: Sequence[str], writable: Sequence[Path]) -> Outcome:
    """Run the command in the machine, in this process's working directory and environment; its output goes to ours.

    All of the host's files can be read there; what lies in the `writable` folders can be changed. can0 and can1 are
    there and down, on one bus. Raises UserError where the machine
    does not start.
    """
    with tempfile.TemporaryDirectory(prefix="parkctl-machine-") as name:
        folder = Path(name)
        shared = [folder, *(path.resolve() for path in writable)]
        _write_enter(folder, command)
        initramfs = folder.with_name(f"{folder.name}.cpio")
        initramfs.write_bytes(_initramfs(folder, shared))
        try:
            return _boot(initramfs, folder, shared)
        finally:
            initramfs.unlink()


def _boot(initramfs: Path, folder: Path, shared: Sequence[Path]) -> Outcome:
    shares = [("machine", Path("/"), ",readonly=on"), *((f"w{i}", path, "") for i, path in enumerate(shared))]
    command = [
        *(QEMU, "-accel", "tcg,thread=multi", "-cpu", "max", "-smp", "2", "-m", str(MEMORY_MB), "-no-reboot"),
        *("-nodefaults", "-display", "none", "-serial", "stdio", "-kernel", str(machine_folder() / "vmlinuz")),
        *("-initrd", str(initramfs), "-append", "console=ttyS0 quiet panic=-1 rdinit=/init tsc=reliable irqaffinity=0"),
        *("-object", "can-bus,id=bus", "-device", "kvaser_pci,canbus=bus", "-device", "kvaser_pci,canbus=bus"),
        *(
            part
            for tag, path, more in shares
            for part in ("-virtfs", f"local,path={path},mount_tag={tag},security_model=none,multidevs=remap{more}")
        ),
    ]
    begun_s = time.monotonic()
    boot_s = None
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=die_with_parent,  # noqa: PLW1509  no thread runs here
    )
    try:
        while process.poll() is None:
            time.sleep(0.1)
            if boot_s is None and (folder / "started").exists():
                boot_s = time.monotonic() - begun_s
            if boot_s is None and time.monotonic() - begun_s > BOOT_LIMIT_S:
                raise UserError(f"guest --hardware: the machine did not start within {BOOT_LIMIT_S:.0f} s")
    finally:
        process.kill()
        complaints = (process.communicate()[1] or "").strip().splitlines()
    status = folder / "status"
    if boot_s is None or not status.is_file():
        why = complaints[-1] if complaints else "it ended without a status"
        raise UserError(f"guest --hardware: the machine did not finish: {why}")
    return Outcome(int(status.read_text()), boot_s)


def _write_enter(folder: Path, command: Sequence[str]) -> None:
    """Write what the machine runs on the host's root: environment, folder, command."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath), "/usr/sbin:/sbin"])
    program = shutil.which(command[0], path=path)
    if program is None:
        raise UserError(f"guest: {command[0]}: there is no such command")
    kept = {name: value for name, value in os.environ.items() if name in {"HOME", "LANG", "PYTHONPATH", "USER"}}
    environment = kept | {"PATH": path, "PYTHONDONTWRITEBYTECODE": "1", "PARKCTL_IN_GUEST": "1"}
    lines = [
        *(f"export {name}={shlex.quote(value)}" for name, value in environment.items()),
        f"cd {shlex.quote(str(Path.cwd()))} || exit 126",
        f"exec {shlex.join([str(Path(program).absolute()), *command[1:]])}",
    ]
    (folder / "enter.sh").write_text("\n".join(lines) + "\n")


def _plan(folder: Path, shared: Sequence[Path]) -> str:
    needed = [Path.cwd(), PROJECT, Path(sys.prefix), Path(sys.base_prefix)]
    hidden = sorted({path for path in needed if path.parts[1:2] in {("tmp",), ("run",), ("dev",)}})
    lines = [
        f"modules={shlex.quote(' '.join(Path(module).name for module in MODULES))}",
        f"folder={shlex.quote(str(folder))}",
        "places() {",
        *(f"  readable {shlex.quote(str(path))}" for path in hidden),
        *(f"  writable w{index} {shlex.quote(str(path))}" for index, path in enumerate(shared)),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _initramfs(folder: Path, shared: Sequence[Path]) -> bytes:
    """Return the archive with all that the kernel needs before the host's files are there."""
    machine = machine_folder()
    entries: list[tuple[str, int, bytes]] = [
        (name, 0o040755, b"") for name in ("bin", "modules", "dev", "root", "host")
    ]
    entries.append(("bin/busybox", 0o100755, (machine / "busybox").read_bytes()))
    entries += [(f"bin/{applet}", 0o120777, b"busybox") for applet in APPLETS]
    entries += [(f"modules/{name}", 0o100644, (machine / name).read_bytes()) for name in map(_name, MODULES)]
    entries.append(("plan.sh", 0o100644, _plan(folder, shared).encode()))
    entries.append(("init", 0o100755, b"#!/bin/sh\n" + INIT.read_bytes()))
    return cpio(entries)


def _name(module: str) -> str:
    return Path(module).name


def cpio(entries: Iterable[tuple[str, int, bytes]]) -> bytes:
    """Return an archive in the kernel's format "newc" of (name, mode, content).

    Source: Documentation/driver-api/early-userspace/buffer-format.rst of the kernel.
    """
    archive = bytearray()
    for number, (name, mode, content) in enumerate([*entries, ("TRAILER!!!", 0, b"")], 1):
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(path), 0)
        archive += b"070701" + b"".join(b"%08X" % field for field in fields) + path
        archive += bytes(-len(archive) % 4) + content
        archive += bytes(-len(archive) % 4)
    return bytes(archive)
