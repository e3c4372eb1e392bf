"""The table of a study as a Parquet file, which pandas, polars and others open."""

from __future__ import annotations

import io
import json

from orthocal.study.runner import StudyTable


def to_parquet(table: StudyTable) -> bytes:
    """A table as the bytes of a Parquet file; the study itself is in its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrow = pa.table({name: pa.array(cells) for name, cells in table.columns.items()})
    document = json.dumps(table.study.document, sort_keys=True)
    arrow = arrow.replace_schema_metadata({"orthocal_study": document})
    stream = io.BytesIO()
    pq.write_table(arrow, stream, compression="zstd")
    return stream.getvalue()
