"""The documentation's five questions, each in SQL and in polars."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import polars as pl
from polars.testing import assert_frame_equal

from fieldcal.warehouse import Warehouse

PAGE = (Path(__file__).parents[1] / "docs/how-to/ask-the-history.md").read_text(encoding="utf-8")
QUESTION = re.compile(r"<!-- question -->\n\*\*(.+?)\*\*\n\n```sql\n(.+?)```\n\n```python\n(.+?)```", re.DOTALL)
QUESTIONS = QUESTION.findall(PAGE)


def answered(warehouse: Warehouse, sql: str, python: str) -> pl.DataFrame:
    """The answer, which is the same in both."""
    names: dict[str, Any] = {"pl": pl, "w": warehouse}
    exec(python, names)
    answer: pl.DataFrame = names["answer"]
    assert_frame_equal(warehouse.sql(sql), answer, check_dtypes=False, rel_tol=1e-9)
    return answer
