"""The campaign's rows as a Parquet file: one row a run, what the campaign is in the file's metadata."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from sim.errors import UserError
from tools.campaign.results import COLUMNS, WHOLE, Rows

KEY = b"parkctl.campaign"
"""Entry of the schema's metadata: JSON with what the campaign is, and the table of draws."""


def write_rows(file: Path, rows: Rows, about: dict[str, Any]) -> None:
    """Write the file; it is there whole or not at all."""
    import pyarrow as pa  # noqa: PLC0415 -- 100 MiB; only where it is used
    import pyarrow.parquet as pq  # noqa: PLC0415

    arrays = [
        pa.array(rows[:, place].astype(np.int64) if name in WHOLE else rows[:, place])
        for place, name in enumerate(COLUMNS)
    ]
    table = pa.Table.from_arrays(arrays, names=list(COLUMNS)).replace_schema_metadata({KEY: json.dumps(about)})
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        pq.write_table(table, temporary, compression="zstd")
        with temporary.open("rb") as written:
            os.fsync(written.fileno())
        temporary.replace(file)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f"{file}: cannot be written: {error.strerror or error}") from None


def read_rows(file: Path) -> tuple[Rows, dict[str, Any]]:
    """Return the rows of a finished campaign and what it is."""
    import pyarrow as pa  # noqa: PLC0415
    import pyarrow.parquet as pq  # noqa: PLC0415

    try:
        table = pq.read_table(file)
        about = json.loads((table.schema.metadata or {})[KEY])
        columns = [table.column(name).to_numpy().astype(np.float64) for name in COLUMNS]
    except OSError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror or error}") from None
    except (pa.ArrowException, KeyError, ValueError):
        raise UserError(f"{file}: not the Parquet file of a campaign of this version of parkctl") from None
    return np.stack(columns, axis=1), about
