"""A fleet in groups of vehicles that share no unit with others: each is asked by itself, so that memory holds one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import polars as pl

from fieldcal.warehouse import Warehouse

AT_ONCE = 500_000
"""Rows of the history of a group, about: some 200 MB. Vehicles that share units are together, however many rows."""


def groups(root: Path, tables: Iterable[str], at_once: int = AT_ONCE) -> Iterator[list[str]]:
    """Vehicles that have rows in `tables`, each in one group, in order; all flights of a unit are of one group.

    Raises
    ------
    WarehouseError
        As `fieldcal.warehouse.Warehouse.scan`.
    """
    warehouse = Warehouse(root)
    counted = [warehouse.scan(table).group_by("vehicle_id", "unit_id").len() for table in tables]
    rows: dict[str, int] = {}
    vehicles_of: dict[str, list[str]] = {}
    for vehicle, unit, n in pl.concat(pl.collect_all(counted)).sort("vehicle_id", "unit_id").iter_rows():
        rows[vehicle] = rows.get(vehicle, 0) + n
        vehicles_of.setdefault(unit, []).append(vehicle)
    group: list[str] = []
    for together in _together(rows, vehicles_of):
        group += together
        if sum(rows[vehicle] for vehicle in group) >= at_once:
            yield group
            group = []
    if group:
        yield group


def _together(vehicles: Iterable[str], vehicles_of: Mapping[str, list[str]]) -> list[list[str]]:
    """Vehicles that share a unit, or share one with one that does, and so on."""
    first = {vehicle: vehicle for vehicle in vehicles}

    def first_of(vehicle: str) -> str:
        while first[vehicle] != vehicle:
            vehicle = first[vehicle]
        return vehicle

    for sharing in vehicles_of.values():
        least = min(map(first_of, sharing))
        for vehicle in sharing:
            first[first_of(vehicle)] = least
    found: dict[str, list[str]] = {}
    for vehicle in first:
        found.setdefault(first_of(vehicle), []).append(vehicle)
    return list(found.values())
