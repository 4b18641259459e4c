"""The flight recorder: the last five seconds of cycles, kept in memory, written out when the loop has ended."""

import csv
import os
from pathlib import Path

from firmware_py.core.signals import Inputs, Outputs

CYCLES = 500


class FlightRecord:
    """A ring of the newest cycles' inputs and outputs; appending keeps two references and nothing else."""

    def __init__(self) -> None:
        self._ring: list[tuple[Inputs, Outputs] | None] = [None] * CYCLES
        self._next = 0

    def append(self, inputs: Inputs, outputs: Outputs) -> None:
        """Keep one cycle, overwriting the oldest."""
        self._ring[self._next] = (inputs, outputs)
        self._next = (self._next + 1) % CYCLES

    def cycles(self) -> list[tuple[Inputs, Outputs]]:
        """Return the kept cycles, oldest first."""
        ordered = self._ring[self._next :] + self._ring[: self._next]
        return [cycle for cycle in ordered if cycle is not None]

    def write_csv(self, file: Path) -> None:
        """Write the kept cycles, a row a cycle, a column a signal; the file appears whole or not at all."""
        cycles = self.cycles()
        temporary = file.with_name(file.name + ".part")
        with temporary.open("w", newline="", encoding="ascii") as stream:
            writer = csv.writer(stream)
            if cycles:
                writer.writerow(["now_us", *_names(cycles[0][0]), *_names(cycles[0][1])])
            for inputs, outputs in cycles:
                writer.writerow([inputs.now_us, *_values(inputs), *_values(outputs)])
        os.replace(temporary, file)


def _names(struct: Inputs | Outputs) -> list[str]:
    return [name for part in struct if isinstance(part, tuple) for name in part._fields]


def _values(struct: Inputs | Outputs) -> list[float]:
    return [value for part in struct if isinstance(part, tuple) for value in part]
