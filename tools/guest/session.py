"""One command in the guest: boot, relay output and signals, halt, hand back its exit status."""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from sim.errors import UserError
from tools.guest.image import Image

BOOT_LIMIT_S = 60.0
"""Boot takes two to five seconds; a loaded machine is given its time."""
END_GRACE_S = 30.0
"""After a signal that ends things the command gets so long before the guest is switched off."""
MEMORY_MB = 1024
HIGHEST_PRIORITY = -20
INIT = Path(__file__).resolve().parent / "init.sh"
PROJECT = Path(__file__).resolve().parent.parent.parent
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_NOT_PASSED_ON = {"PWD", "OLDPWD", "SHLVL", "_", "TMPDIR", "TMP", "TEMP"}


class Outcome(NamedTuple):
    """How it went: the command's exit status as a shell gives it (128 + signal), and how long the boot took."""

    status: int
    boot_s: float


def run_in_guest(image: Image, command: Sequence[str], writable: Sequence[Path]) -> Outcome:
    """Run the command in the guest, in this process's working directory and environment.

    All of the machine's files can be read there; what lies in the `writable` folders can be changed. Raises UserError
    where the guest does not start.
    """
    with tempfile.TemporaryDirectory(prefix="parkctl-guest-", dir=_plain_folder()) as name:
        return _Session(image, command, writable, Path(name)).run()


def _plain_folder() -> str | None:
    """Return where the guest's own folder can be: its path stands in the kernel's command line, so without a space."""
    return "/tmp" if " " in tempfile.gettempdir() else None


class _Session:
    def __init__(self, image: Image, command: Sequence[str], writable: Sequence[Path], folder: Path) -> None:
        self._image = image
        self._command = command
        self._writable = writable
        self._folder = folder
        self._terminal = sys.stdin.isatty() and sys.stdout.isatty()
        self._errors_apart = not (self._terminal and sys.stderr.isatty())
        self._signals: list[int] = []
        self._begun_s = time.monotonic()
        self._boot_s: float | None = None
        self._end_s: float | None = None

    def run(self) -> Outcome:
        self._write_plan()
        with contextlib.ExitStack() as stack:
            pipes = [_Pipe(stack) for _ in range(4)]
            wake = _Pipe(stack)
            os.set_blocking(wake.write, False)
            stack.enter_context(self._noting_signals(wake.write))
            keys, output, errors, control = pipes
            process = self._boot(keys, output, errors, control)
            stack.callback(_end, process)
            for end in (keys.read, output.write, errors.write, control.read):
                os.close(end)
            if self._terminal:
                stack.enter_context(_raw_terminal())
            self._relay(process, keys, output, errors, control, wake)
        return self._outcome()

    # ----------------------------------------------------------------------------------------------------------- boot

    def _write_plan(self) -> None:
        folder = self._folder
        (folder / "busybox").symlink_to(self._image.busybox)
        lines = [
            f"modules={shlex.quote(' '.join(str(module) for module in self._modules()))}",
            f"terminal={shlex.quote(self._terminal_settings())}",
            f"errors_apart={'yes' if self._errors_apart else ''}",
            "failed=",
            "places() {",
            *(f"  readable {shlex.quote(str(path))}" for path in self._hidden_places()),
            *(f"  writable {shlex.quote(str(path))}" for path in [folder, *self._writable]),
            "}",
        ]
        (folder / "plan.sh").write_text("\n".join(lines) + "\n")
        path = os.pathsep.join(
            [str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath), str(self._image.tools)]
        )
        search = f"{path}:/usr/sbin:/sbin:{folder / 'applets'}"
        environment = {
            **{name: value for name, value in os.environ.items() if name.isidentifier() and name not in _NOT_PASSED_ON},
            "PATH": search,
            "PARKCTL_IN_GUEST": "1",
        }
        (folder / "applets").mkdir()
        for applet in ("ip", "insmod", "rmmod", "lsmod"):  # for hosts that lack them; the host's own come first
            (folder / "applets" / applet).symlink_to(self._image.busybox)
        # Looked up here: busybox's shell would take a command of its own for one of the same name.
        program = shutil.which(self._command[0], path=search)
        if program is None:
            raise UserError(f"guest: {self._command[0]}: there is no such command")
        (folder / "enter.sh").write_text(
            "\n".join(
                [
                    "echo $$ >/run/parkctl/pid",
                    *(f"export {name}={shlex.quote(value)}" for name, value in environment.items()),
                    f"cd {shlex.quote(str(Path.cwd()))} || exit 126",
                    f"exec {shlex.join([str(Path(program).absolute()), *self._command[1:]])}",
                ]
            )
            + "\n"
        )

    def _modules(self) -> list[Path]:
        """Link the modules into the guest's folder, whose path holds no space."""
        made = []
        for module in self._image.modules:
            made.append(self._folder / module.name)
            made[-1].symlink_to(module)
        return made

    def _hidden_places(self) -> list[Path]:
        """Return the folders that are needed and that the guest's own /tmp, /run and /dev would hide."""
        image = self._image
        needed = [Path.cwd(), PROJECT, Path(sys.prefix), Path(sys.base_prefix), image.kernel.parent]
        hidden = [path for path in needed if path.parts[1:2] in {("tmp",), ("run",), ("dev",)}]
        return sorted(set(hidden))  # outer ones first

    def _terminal_settings(self) -> str:
        if not self._terminal:
            return ""
        size = shutil.get_terminal_size()
        return f"rows {size.lines} cols {size.columns}"

    def _boot(self, keys: _Pipe, output: _Pipe, errors: _Pipe, control: _Pipe) -> subprocess.Popen[bytes]:
        folder = self._folder
        lines = [
            f"ssl0=fd:{keys.read},fd:{output.write}",
            f"ssl1=null,fd:{errors.write}",
            f"ssl2=fd:{control.read},null",
        ]
        init = INIT if " " not in str(INIT) else Path(shutil.copy(INIT, folder / "init.sh"))
        arguments = [
            f"mem={MEMORY_MB}M", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "quiet", "panic=-1",
            "con=null", "con0=null,fd:1", *lines, f"uml_dir={folder}/", "umid=guest",
            f"init={folder / 'busybox'}", "--", "sh", str(init), str(folder),
        ]  # fmt: skip
        passed = (keys.read, output.write, errors.write, control.read)
        with (folder / "kernel.txt").open("wb") as said:
            try:
                return subprocess.Popen(
                    [str(self._image.kernel), *arguments],
                    stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                    pass_fds=passed, env=os.environ | {"TMPDIR": _memory_folder(folder)},
                    start_new_session=True,  # a Ctrl-C of the terminal is for the command in the guest
                    preexec_fn=_prepare,  # noqa: PLW1509  no thread runs here
                )  # fmt: skip
            except OSError as error:
                raise UserError(f"the guest does not start: {self._image.kernel}: {error.strerror}") from None

    # ---------------------------------------------------------------------------------------------------------- relay

    def _relay(
        self, process: subprocess.Popen[bytes], keys: _Pipe, output: _Pipe, errors: _Pipe, control: _Pipe, wake: _Pipe
    ) -> None:
        """Pass everything on until the guest has halted."""
        targets = {output.read: 1, errors.read: 2}
        sources = [*targets, wake.read, *([0] if self._terminal else [])]
        while targets:
            ready, _, _ = select.select(sources, [], [], 0.1)
            for source in ready:
                content = os.read(source, 1 << 16)
                if source in targets and content:
                    self._write(targets[source], content)
                elif source in targets:
                    del targets[source]
                    sources.remove(source)
                elif source == 0 and content:
                    os.write(keys.write, content)
                elif source == 0:
                    sources.remove(0)
                    os.write(keys.write, b"\x04")
            self._watch(process, control.write)
            if process.poll() is not None and not ready:
                return

    def _write(self, target: int, content: bytes) -> None:
        try:
            while content:
                content = content[os.write(target, content) :]
        except BrokenPipeError:
            self._signals.append(signal.SIGTERM)  # nobody reads any more

    def _watch(self, process: subprocess.Popen[bytes], control: int) -> None:
        """Note the end of the boot, pass signals on once it is there, and end what does not end."""
        now_s = time.monotonic()
        if self._boot_s is None and (self._folder / "started").exists():
            self._boot_s = now_s - self._begun_s
        if self._boot_s is None:
            if now_s - self._begun_s > BOOT_LIMIT_S or self._signals:
                _end(process)
            return
        while self._signals:
            number = self._signals.pop(0)
            os.write(control, f"{number}\n".encode())
            self._end_s = self._end_s or now_s + END_GRACE_S
        if self._end_s is not None and now_s > self._end_s:
            _end(process)

    @contextlib.contextmanager
    def _noting_signals(self, wake: int) -> Iterator[None]:
        def note(number: int, _frame: FrameType | None) -> None:
            self._signals.append(number)

        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = {number: signal.signal(number, note) for number in numbers}
        old_wake = signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(old_wake)
            for number, handler in before.items():
                signal.signal(number, handler)

    # -------------------------------------------------------------------------------------------------------- outcome

    def _outcome(self) -> Outcome:
        folder = self._folder
        with contextlib.suppress(OSError, ValueError):
            return Outcome(int((folder / "status").read_text()), self._boot_s or time.monotonic() - self._begun_s)
        if self._signals or self._end_s is not None:
            raise KeyboardInterrupt
        if (folder / "failed").exists():
            raise UserError(f"the guest has no CAN: {(folder / 'failed').read_text().strip()} failed")
        said = [line.strip() for line in (folder / "kernel.txt").read_text(errors="replace").splitlines()]
        said = [line for line in said if line]
        what = "did not start" if self._boot_s is None else "ended before its command"
        raise UserError(f"the guest {what}: {said[-1] if said else 'it said nothing'} (see README, vcan0)")


class _Pipe:
    """Both ends of a pipe, closed with the stack."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.read, self.write = os.pipe()
        stack.callback(self._close)

    def _close(self) -> None:
        for end in (self.read, self.write):
            with contextlib.suppress(OSError):
                os.close(end)


def _memory_folder(folder: Path) -> str:
    """Return where the guest's memory file lies: in memory where there is room for it, and it may be executed."""
    shared = Path("/dev/shm")
    with contextlib.suppress(OSError):
        stats = os.statvfs(shared)
        if stats.f_bavail * stats.f_frsize > (MEMORY_MB << 20) and not stats.f_flag & os.ST_NOEXEC:
            return str(shared)
    return str(folder)


def _prepare() -> None:
    """Have the kernel end the guest when its parent is killed, and give it a CPU; runs between fork and exec.

    A system call in the guest is a few changes of context on the host, which are twice as fast on one CPU as across
    two; and the guest cannot keep better time than the host gives it. Both only where they are permitted, and never on
    the host's only CPU. No real-time priority: the host's kernel takes 50 ms of every second from it under load.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    cpus = os.sched_getaffinity(0)
    if len(cpus) > 1:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, HIGHEST_PRIORITY)
            os.sched_setaffinity(0, {_quietest(cpus)})
            # Where the kernel groups processes by session, priorities count between the groups.
            Path("/proc/self/autogroup").write_text(str(HIGHEST_PRIORITY))


def _quietest(cpus: set[int]) -> int:
    """Return the CPU with the fewest other guests, the last one of equals."""
    guests: list[set[int]] = []
    for link in Path("/proc").glob("[0-9]*/exe"):
        with contextlib.suppress(OSError):
            if link.readlink().name == "linux.uml":
                guests.append(os.sched_getaffinity(int(link.parent.name)))
    return min(sorted(cpus, reverse=True), key=lambda cpu: sum(guest == {cpu} for guest in guests))


def _end(process: subprocess.Popen[bytes]) -> None:
    """Switch the guest off, with all that runs in it."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@contextlib.contextmanager
def _raw_terminal() -> Iterator[None]:
    """Hand every key to the guest's terminal, which does the editing and the signals; put it back in the end."""
    before = termios.tcgetattr(0)
    tty.setraw(0)
    try:
        yield
    finally:
        termios.tcsetattr(0, termios.TCSADRAIN, before)
