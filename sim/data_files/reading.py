"""Finding, reading and checking TOML files; a mistake is one line that names file and key."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sim.errors import UserError

ROOT = Path(__file__).resolve().parent.parent.parent
FOLDERS = {
    "vehicle": ROOT / "dbc" / "vehicles",
    "course": ROOT / "dbc" / "courses",
    "scenario": ROOT / "sim" / "scenarios",
}


def shipped_names(kind: str) -> list[str]:
    """Names of the files of a kind ("vehicle", "course", "scenario") that come with the project."""
    return sorted(path.stem for path in FOLDERS[kind].glob("*.toml"))


def find_file(kind: str, name_or_path: str | Path) -> Path:
    """Path of a shipped file given by its name, or of a user's file given by its path.

    A text without "/" that does not end in ".toml" is a name. Raises UserError where there is no such file.
    """
    text = str(name_or_path)
    known = ", ".join(shipped_names(kind))
    if isinstance(name_or_path, str) and "/" not in text and not text.endswith(".toml"):
        path = FOLDERS[kind] / f"{text}.toml"
        if not path.is_file():
            raise UserError(f"no {kind} is called {text!r}; there are {known}, or give the path of a .toml file")
        return path
    path = Path(text)
    if not path.is_file():
        raise UserError(f"{text}: no such {kind} file; give the path of a .toml file or one of the names {known}")
    return path


def read_toml(path: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the bytes of a TOML file and what it says."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return raw, tomllib.loads(raw.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not a text file in UTF-8 (byte {error.start})") from None
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise UserError(f"{path}: not valid TOML: nested too deeply") from None


_Model = TypeVar("_Model", bound=BaseModel)


def validate(path: Path, model: type[_Model], content: Mapping[str, Any]) -> _Model:
    """Return what a file says as a checked model; the file's first mistake is a UserError of one line."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise UserError(f"{path}: {_first_mistake(error, model)}") from None


def _first_mistake(error: ValidationError, model: type[BaseModel]) -> str:
    """One line for the first mistake that pydantic found, naming the key as it stands in the file."""
    mistakes = error.errors()
    # An unknown key is most often the misspelt twin of a missing one: it says more.
    mistake = next((m for m in mistakes if m["type"] == "extra_forbidden"), mistakes[0])
    key, siblings = _as_in_the_file(model, mistake["loc"])
    if mistake["type"] == "extra_forbidden":
        text = f"{key}: unknown key" + (f"; known here: {', '.join(siblings)}" if siblings else "")
    elif mistake["type"] == "missing":
        text = f"{key}: missing"
    elif mistake["type"] == "union_tag_not_found":
        text = f"{key}.rule: missing"
    elif mistake["type"] == "union_tag_invalid":
        text = f"{key}.rule = {shown(mistake['ctx']['tag'])}: must be {mistake['ctx']['expected_tags']}"
    elif mistake["type"] == "value_error":
        what = str(mistake["ctx"]["error"])
        text = f"{key}: {what}" if key else what
    else:
        what = mistake["msg"]
        text = f"{key} = {shown(mistake['input'])}: {what[0].lower()}{what[1:]}"
    more = len(mistakes) - 1
    return text + (f" (and {more} more)" if more else "")


def shown(value: object, most: int = 60) -> str:
    """Return a value as it can stand in one line."""
    text = repr(value)
    return text if len(text) <= most else text[:most] + "..."


def shown_key(text: str) -> str:
    """Return a key as it can stand in one line."""
    return text if text.isprintable() and len(text) <= 60 else shown(text)


def _as_in_the_file(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, list[str]]:
    """Dotted key of a mistake, without pydantic's union tags and with lists counted from 1, and the keys beside it."""
    key = ""
    here: list[type[BaseModel]] = [model]
    siblings: list[str] = []
    for part in location:
        if isinstance(part, int):
            key += f"[{part + 1}]"
            continue
        siblings = list(here[0].model_fields) if len(here) == 1 else []
        tagged = [m for m in here if "rule" in m.model_fields and part in get_args(m.model_fields["rule"].annotation)]
        if tagged and len(here) > 1:
            here = tagged
            continue
        key += f".{shown_key(part)}" if key else shown_key(part)
        field_info = here[0].model_fields.get(part) if len(here) == 1 else None
        here = [] if field_info is None else _models_in(field_info.annotation)
    return key, siblings


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in getattr(annotation, "__args__", ()) for model in _models_in(argument)]


STRICT = ConfigDict(extra="forbid", frozen=True, strict=True)
Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
Text = Annotated[str, Field(min_length=1)]
