"""The cache of stages: complete means that everything the record lists is there and whole."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from fieldcal.warehouse.errors import WarehouseError
from fieldcal.warehouse.rows_as_json import digest
from fieldcal.warehouse.sealed import BrokenSeal, seal, unseal
from fieldcal.warehouse.stage_store import StageStore

WHERE = ("gyro_equation", "0123456789abcdef", "f" * 32)


SIDE = 40
"""Of a matrix that is too large to lie in the record."""


def outputs() -> dict[str, pl.DataFrame]:
    cells = [(row, column) for row in range(SIDE) for column in range(SIDE)]
    return {
        "covariance": pl.DataFrame(
            {"row": [r for r, _ in cells], "column": [c for _, c in cells], "value": [float(r == c) for r, c in cells]},
            schema={"row": pl.Int32, "column": pl.Int32, "value": pl.Float64},
        ),
        "vps_aligned": pl.DataFrame(
            schema={"t_ns": pl.Int64}
            | dict.fromkeys(("qx", "qy", "qz", "qw"), pl.Float64)
            | {f"rate_{axis}_radps": pl.Float64 for axis in "xyz"}
        ),
    }


def saved(root: Path) -> tuple[StageStore, dict[str, Any]]:
    stages = StageStore(root)
    return stages, stages.save(*WHERE, outputs(), {"status": "ok", "measured": {"condition": 3.5, "n": 7}})


def test_what_is_saved_is_complete_and_comes_back(tmp_path: Path) -> None:
    stages, record = saved(tmp_path)
    assert stages.complete(*WHERE) == record
    assert record["status"] == "ok"
    assert record["measured"] == {"condition": 3.5, "n": 7}
    assert record["outputs"]["covariance"]["rows"] == SIDE**2
    loaded = stages.load(*WHERE)
    assert {name: frame.equals(outputs()[name]) for name, frame in loaded.items()} == dict.fromkeys(outputs(), True)
    assert set(stages.load(*WHERE, ["vps_aligned"])) == {"vps_aligned"}
    with pytest.raises(WarehouseError, match="kept no table samples"):
        stages.load(*WHERE, ["samples"])


def test_a_small_table_lies_in_the_record_and_comes_back_to_the_bit(tmp_path: Path) -> None:
    values = [0.1, -0.0, 1e-300, float("nan"), float("inf"), -float("inf"), None]
    rows = pl.DataFrame(
        {"sensor": ["é", *"bcdefg"], "axis": ["x"] * 7, "reason_code": ["c"] * 7, "number": values, "limit": values}
    ).with_columns(fatal=pl.Series([True, False] * 3 + [True]), reason=pl.Series([None, *"bcdefg"]))
    stages = StageStore(tmp_path)
    record = stages.save(*WHERE, {"faults": rows}, {"status": "ok"})
    assert [path.name for path in stages.folder(*WHERE).iterdir()] == ["run.json"]
    loaded = stages.load(*WHERE)["faults"]
    assert loaded.select(rows.columns).equals(rows)
    assert np.signbit(loaded["number"][1])
    assert digest(loaded) == record["outputs"]["faults"]["sha256"]
    assert stages.complete(*WHERE) == record


def test_what_is_handed_on_is_told_and_nowhere(tmp_path: Path) -> None:
    stages = StageStore(tmp_path)
    record = stages.save(*WHERE, outputs(), {"status": "ok"}, handed_on=["covariance"])
    assert record["outputs"]["covariance"] == {
        "sha256": digest(outputs()["covariance"]),
        "rows": SIDE**2,
        "handed_on": True,
    }
    assert set(stages.load(*WHERE)) == {"vps_aligned"}
    assert stages.complete(*WHERE) == record
    with pytest.raises(WarehouseError, match="kept no table covariance"):
        stages.load(*WHERE, ["covariance"])
    stages.forget(*WHERE)
    assert stages.complete(*WHERE) is None


def test_the_digest_of_rows_is_that_of_their_values_and_order() -> None:
    rows = pl.DataFrame({"a": [1.0, 2.0, None], "b": ["x", "yz", ""]})
    others = [
        rows.reverse(),
        rows.with_columns(a=pl.col("a").fill_null(0.0)),
        rows.with_columns(a=pl.col("a").fill_null(float("nan"))),
        rows.with_columns(b=pl.Series(["xy", "z", ""])),
        rows.with_columns(b=pl.Series(["x", "yz", None])),
        rows.rename({"a": "c"}),
        rows.with_columns(a=pl.col("a").cast(pl.Int64)),
        rows.head(2),
    ]
    assert digest(rows.clone()) == digest(rows)
    assert len({digest(other) for other in (rows, *others)}) == 1 + len(others)


def test_saving_again_gives_the_same_bytes(tmp_path: Path) -> None:
    first, second = saved(tmp_path / "a")[1], saved(tmp_path / "b")[1]
    assert first == second
    assert saved(tmp_path / "a")[1] == first


def test_incomplete_torn_edited_or_foreign_is_not_complete(tmp_path: Path) -> None:
    stages = StageStore(tmp_path)
    assert stages.complete(*WHERE) is None
    with pytest.raises(WarehouseError, match="holds no complete result"):
        stages.load(*WHERE)
    folder = stages.folder(*WHERE)
    for name in ("covariance.parquet", "run.json"):
        saved(tmp_path)
        whole = (folder / name).read_bytes()
        for damaged in (whole[:-1], b"", whole[:50] + bytes([whole[50] ^ 4]) + whole[51:], whole + b"\n"):
            (folder / name).write_bytes(damaged)
            assert stages.complete(*WHERE) is None, name
        (folder / name).unlink()
        assert stages.complete(*WHERE) is None
    saved(tmp_path)
    other = stages.folder("gyro_equation", "another-flight", WHERE[2])
    folder.rename(other.parent.parent / "moved")
    other.parent.mkdir(parents=True)
    (other.parent.parent / "moved").rename(other)
    assert stages.complete("gyro_equation", "another-flight", WHERE[2]) is None


def test_a_damaged_output_is_not_loaded(tmp_path: Path) -> None:
    stages, _ = saved(tmp_path)
    path = stages.folder(*WHERE) / "covariance.parquet"
    data = bytearray(path.read_bytes())
    data[20] ^= 1
    path.write_bytes(data)
    with pytest.raises(WarehouseError, match="is not what the stage wrote"):
        stages.load(*WHERE)


def test_a_failed_save_is_not_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stages, record = saved(tmp_path / "whole")
    monkeypatch.setattr(
        "fieldcal.warehouse.stage_store.write_bytes", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    for folder in ("whole", "fresh"):
        with pytest.raises(KeyboardInterrupt):
            saved(tmp_path / folder)
    assert StageStore(tmp_path / "fresh").complete(*WHERE) is None
    assert stages.complete(*WHERE) == record  # the same outputs: who reads them meanwhile is not disturbed


def test_records_are_plain_json(tmp_path: Path) -> None:
    stages = StageStore(tmp_path)
    with pytest.raises(ValueError, match="JSON compliant"):
        stages.save(*WHERE, {}, {"measured": {"x": float("nan")}})
    with pytest.raises(TypeError):
        stages.save(*WHERE, {}, {"measured": {"x": object()}})
    assert stages.complete(*WHERE) is None


SEALED_BY_THE_FIRST_NIGHTS = """{
 "a": [
  1
 ],
 "sealed_sha256": "%s",
 "z": "ü"
}
"""


@pytest.mark.parametrize("former", [False, True])
def test_seal_finds_every_changed_byte(former: bool) -> None:
    record = {"a": [1], "z": "ü"}
    data = seal(record)
    if former:
        digest = hashlib.sha256(
            SEALED_BY_THE_FIRST_NIGHTS.replace(' "sealed_sha256": "%s",\n', "").encode()
        ).hexdigest()
        data = (SEALED_BY_THE_FIRST_NIGHTS % digest).encode()
    assert unseal(data) == record
    for position in range(len(data)):
        for bit in (1, 32, 128):
            changed = bytearray(data)
            changed[position] ^= bit
            with pytest.raises(BrokenSeal):
                unseal(bytes(changed))
