"""One cycle takes no more opcodes than it did: exact on any machine, so this is the gate on speed."""

import pytest

from firmware_py.core import controller
from sim.errors import UserError
from tools.bench import opcodes

TOLERANCE = 0.01


def test_opcodes_a_cycle_are_the_stored_ones():
    stored = opcodes.stored_counts().get(opcodes.python_version())
    if stored is None:
        pytest.skip(f"no counts stored for Python {opcodes.python_version()}; parkctl bench --update-opcodes")
    counted = opcodes.count_opcodes()
    assert counted.keys() == stored.keys()
    differing = [
        f"{name}: {counted[name]:.1f} opcodes a cycle, stored {count:.1f} ({counted[name] / count - 1:+.1%})"
        for name, count in stored.items()
        if abs(counted[name] / count - 1.0) > TOLERANCE
    ]
    assert not differing, (
        "; ".join(differing) + ". Where this is meant, store the new counts: .venv/bin/parkctl bench --update-opcodes"
    )


def test_counting_sees_every_function_below_and_is_exact():
    def short():
        return 1

    def long():
        return short() + short()

    assert 0 < opcodes.opcodes_of(short) < opcodes.opcodes_of(long)
    assert opcodes.opcodes_of(long) == opcodes.opcodes_of(long)


def test_a_dearer_core_is_noticed(monkeypatch):
    counted = opcodes.opcodes_of(lambda: controller._elapsed_s(0, 10_000))

    def dearer(last_us, now_us):
        return max(min((now_us - last_us) * 1e-6, controller.LONGEST_CYCLE_S), 0.0) + 0.0

    monkeypatch.setattr(controller, "_elapsed_s", dearer)
    assert opcodes.opcodes_of(lambda: controller._elapsed_s(0, 10_000)) != counted


def test_storing_keeps_the_counts_of_other_versions(tmp_path, monkeypatch):
    monkeypatch.setattr(opcodes, "STORED", tmp_path / "opcodes.txt")
    opcodes.STORED.write_text("# text\n2.7 core_step 12.5\n", encoding="utf-8")
    opcodes.store({"core_step": 3.0})
    assert opcodes.stored_counts() == {"2.7": {"core_step": 12.5}, opcodes.python_version(): {"core_step": 3.0}}


def test_a_broken_line_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(opcodes, "STORED", tmp_path / "opcodes.txt")
    opcodes.STORED.write_text("3.11 core_step many\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"opcodes\.txt:1: must be VERSION NAME COUNT"):
        opcodes.stored_counts()
