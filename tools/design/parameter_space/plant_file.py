"""A user's plants: written out as num/den, or in a TOML or JSON file."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sim.errors import UserError
from tools.design.parameter_space.loop import Plant, plant_of

KEYS = {"name", "num", "den", "A", "B", "C", "D", "delay_s", "period_s", "speed_mps"}
TOP_KEYS = KEYS | {"plants", "input_unit", "output_unit", "description"}
HELP = """\
a plant is given as "num / den" in powers of s, highest first, as "2 / 1 3 2 0", or as a .toml or .json file:
  name = "oven"            num = [2]  den = [1, 3, 2, 0]     or matrices  A = [[...]]  B = [...]  C = [...]  D = 0
  delay_s = 0.5            input_unit = "W"  output_unit = "K"    period_s = 0.1 for a sampled plant, in powers of z
several plants (speeds, corners of a box), which must all be kept in the region, as tables [[plants]] with the keys
name, num, den (or A, B, C, D), delay_s, and speed_mps if the page is to have a slider for it.
"""


class PlantSet(NamedTuple):
    """Plants that must all be kept in the region; speed_mps: one each, or empty."""

    plants: tuple[Plant, ...]
    speeds_mps: tuple[float, ...]
    input_unit: str
    output_unit: str


def read_plants(text: str, delay_s: float = 0.0) -> PlantSet:
    """Read `--plant`; delay_s comes on top of the file's. Raises UserError with one line that names file and key."""
    if text.endswith((".toml", ".json")):
        return _of_file(Path(text), delay_s)
    num, slash, den = text.partition("/")
    if not slash:
        raise UserError(
            f'--plant {text!r}: must be "num / den", as "2 / 1 3 2 0", or a file that ends in .toml or .json'
        )
    plant = plant_of((_numbers(num, "num"), _numbers(den, "den")), delay_s=delay_s)
    return PlantSet((plant,), (), "", "")


def _numbers(text: str, what: str) -> list[float]:
    words = text.replace(",", " ").replace("[", " ").replace("]", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise UserError(f"--plant: {what} {text.strip()!r}: must be numbers, highest power first") from None
    if not numbers or not all(math.isfinite(number) for number in numbers):
        raise UserError(f"--plant: {what} {text.strip()!r}: must be finite numbers, highest power first")
    return numbers


def _of_file(path: Path, delay_s: float) -> PlantSet:
    try:
        raw = path.read_text("utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file in UTF-8") from None
    try:
        content = json.loads(raw) if path.suffix == ".json" else tomllib.loads(raw)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid {path.suffix[1:].upper()}: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: must hold keys and values ({', '.join(sorted(TOP_KEYS))})")
    _known(content, TOP_KEYS, f"{path}")
    entries = content.get("plants", [content])
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(f"{path}: plants: must be tables, [[plants]], one a plant")
    several = "plants" in content
    if several and (KEYS - {"name"}) & set(content):
        wrong = ", ".join(sorted((KEYS - {"name"}) & set(content)))
        raise UserError(f"{path}: {wrong}: belongs into each of the [[plants]]")
    plants, speeds = [], []
    for index, entry in enumerate(entries):
        where = f"{path}: plants[{index}]" if several else f"{path}"
        if several:
            _known(entry, KEYS, where)
        plants.append(_plant(entry, where, path.stem if not several else f"{path.stem} {index}", delay_s))
        if "speed_mps" in entry:
            speeds.append(_number(entry["speed_mps"], f"{where}: speed_mps"))
    if speeds and len(speeds) != len(plants):
        raise UserError(f"{path}: speed_mps: give it for all plants or for none")
    units = [content.get(key, "") for key in ("input_unit", "output_unit")]
    if not all(isinstance(unit, str) for unit in units):
        raise UserError(f"{path}: input_unit, output_unit: must be texts")
    return PlantSet(tuple(plants), tuple(speeds), *units)


def _known(content: dict[str, Any], keys: set[str], where: str) -> None:
    unknown = sorted(set(content) - keys)
    if unknown:
        raise UserError(f"{where}: {unknown[0]}: unknown key; known here: {', '.join(sorted(keys))}")


def _plant(entry: dict[str, Any], where: str, fallback: str, delay_s: float) -> Plant:
    name = str(entry.get("name", fallback))
    late = delay_s + _number(entry.get("delay_s", 0.0), f"{where}: delay_s")
    period = _number(entry["period_s"], f"{where}: period_s") if "period_s" in entry else None
    if period is not None and not period > 0.0:
        raise UserError(f"{where}: period_s = {period}: must be above 0")
    import control  # noqa: PLC0415

    if {"num", "den"} <= set(entry) and not {"A", "B", "C", "D"} & set(entry):
        # Checked before python-control sees it: its own messages speak of other things.
        plant = plant_of((entry["num"], entry["den"]), delay_s=0.0, name=name)
        return plant_of(Plant(plant.num, plant.den, late, period, name))
    if {"A", "B", "C"} <= set(entry) and not {"num", "den"} & set(entry):
        a, b, c = (_matrix(entry[key], f"{where}: {key}") for key in ("A", "B", "C"))
        states = a.shape[0]
        b = b.reshape(-1, 1) if b.shape[0] == 1 and states != 1 else b
        d = _matrix(entry["D"], f"{where}: D") if "D" in entry else np.zeros((c.shape[0], b.shape[1]))
        if a.shape[1] != states or b.shape[0] != states or c.shape[1] != states or d.shape != (c.shape[0], b.shape[1]):
            raise UserError(f"{where}: A {a.shape}, B {b.shape}, C {c.shape}, D {d.shape}: the shapes do not fit")
        return plant_of(control.ss(a, b, c, d, period or 0), delay_s=late, name=name)
    raise UserError(f"{where}: give either num and den, or A, B, C (and D)")


def _matrix(value: Any, what: str) -> np.ndarray[Any, Any]:
    try:
        matrix = np.atleast_2d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise UserError(f"{what}: must be a matrix of numbers, [[row], [row]]") from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise UserError(f"{what}: must be a matrix of finite numbers, [[row], [row]]")
    return matrix


def _number(value: Any, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UserError(f"{what} = {value!r}: must be a finite number")
    return float(value)
