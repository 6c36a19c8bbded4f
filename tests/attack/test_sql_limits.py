"""The limits of SQL hold, whatever the query makes the engine do; what cannot be shown is a sentence."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from fieldcal.warehouse import Warehouse
from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.sql import _idle

TIMEOUT_S = 1.5
WITHIN_S = 8.0
MEMORY_MB = 300
BESIDE_MB = 1100
SAME = [f"c{i} AS (SELECT a.x FROM c{i - 1} a, c{i - 1} b)" for i in range(1, 41)]
BLOW_UPS = {
    "range": "SELECT list(range) FROM range(500000000)",
    "a range in one cell": "SELECT range(500000000)",
    "generate_series": "SELECT generate_series(1, 500000000)",
    "unions": " UNION ALL ".join(["SELECT 1"] * 20_000),
    "nested queries": "WITH c0 AS (SELECT range AS x FROM range(9)), " + ", ".join(SAME) + " SELECT count(*) FROM c40",
    "repeat": "SELECT repeat('x', 4000000000) || repeat('y', 4000000000)",
    "cross join": "SELECT count(*) FROM range(10000000) a, range(10000000) b WHERE a.range + b.range = 7",
    "sort": "SELECT * FROM range(300000000) ORDER BY random()",
}


def peak_kb(pid: object) -> int:
    """The most memory that a process has held."""
    return int(Path(f"/proc/{pid}/status").read_text().split("VmHWM:")[1].split()[0])


@pytest.mark.parametrize("what", BLOW_UPS)
def test_time_and_memory_are_bounded(tmp_path: Path, what: str) -> None:
    began, before_kb = time.monotonic(), peak_kb("self")
    with pytest.raises(WarehouseError) as caught:
        Warehouse(tmp_path).sql(BLOW_UPS[what], timeout_s=TIMEOUT_S, memory_mb=MEMORY_MB)
    assert time.monotonic() - began < WITHIN_S
    assert caught.value.reason_code in ("sql_timeout", "sql_too_large", "sql_wrong")
    assert peak_kb("self") - before_kb < (MEMORY_MB + BESIDE_MB) << 10
    for engine in _idle:
        assert peak_kb(engine._process.pid) < (MEMORY_MB + BESIDE_MB) << 10


def test_the_next_question_is_answered_and_its_engine_reused(tmp_path: Path) -> None:
    warehouse = Warehouse(tmp_path)
    assert warehouse.sql("SELECT 1 AS a").rows() == [(1,)]
    (first,) = _idle[-1:]
    assert warehouse.sql("SELECT count(*) AS n FROM flight").rows() == [(0,)]
    assert _idle[-1] is first
    first._process.kill()
    first._process.wait()
    assert warehouse.sql("SELECT 1 AS a").rows() == [(1,)]


@pytest.mark.parametrize(
    ("query", "told"),
    [
        ("SELECT INTERVAL 3 DAY AS a", "CAST it to VARCHAR"),
        ("SELECT union_value(a := 1) AS a", "CAST it to VARCHAR"),
        ("SELECT 1 AS a, 2 AS a", "name them with AS"),
        ("SELECT DATE '290000-01-01' AS a", "a holds times beyond the years 1 to 9999"),
        ("SELECT 'infinity'::TIMESTAMP AS a", "a holds times beyond the years 1 to 9999"),
        ("SELECT '-infinity'::DATE AS a", "a holds times beyond the years 1 to 9999"),
    ],
)
def test_what_cannot_be_shown_is_a_sentence(tmp_path: Path, query: str, told: str) -> None:
    with pytest.raises(WarehouseError, match=told) as caught:
        Warehouse(tmp_path).sql(query)
    assert caught.value.reason_code == "sql_wrong"
