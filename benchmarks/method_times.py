"""What the methods cost in time: the serial chain, the joint estimate and `auto`, with and without a VPS.

    python benchmarks/method_times.py [--rounds 5] [--flight 40 --flight 200] [--first-seed 1000]

Simulated flights at 185 Hz, the VPS at 350 Hz, translation 0.3 m/s² rms, lever arm unknown. A round flies the pipeline
once by each method on the same flight, in an order that turns from round to round, so that what else the machine does
meets all alike. One Markdown row a flight: processor seconds of the whole pipeline, least / median of the rounds; the
median over the rounds of what `auto` takes over what the others take; and, by `auto`, the dearest stages.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl
from joint_accuracy import MOVING

from fieldcal.config.flight_settings import FlightSettings
from fieldcal.simulation.archive import settings, signals
from fieldcal.simulation.experiment import simulate
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.stage import run_stage

METHODS = ("serial", "joint", "auto")
SETS_A_SECOND = 3 / 40  # of manoeuvres, as in the paper's flight
DEAREST = 3

Costs = dict[str, float]
"""Processor seconds by stage."""


def costs(log: Mapping[str, pl.DataFrame], own: FlightSettings) -> Costs:
    """`run_flight`, stage by stage."""
    tables = {f"ingest.{name}": frame for name, frame in log.items()}
    out = {}
    for stage in PIPELINE:
        began = time.process_time()
        result = run_stage(stage, tables, own)
        out[stage.name] = time.process_time() - began
        tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}
    return out


def row(name: str, vps: str, rounds: Mapping[str, list[Costs]]) -> str:
    total = {method: np.array([sum(c.values()) for c in rounds[method]]) for method in METHODS}
    cells = [name, vps, *(f"{t.min():.2f} / {np.median(t):.2f}" for t in total.values())]
    cells += [f"{np.median(total['auto'] / total[other]):.2f}" for other in ("joint", "serial")]
    by_stage = {stage: float(np.median([c[stage] for c in rounds["auto"]])) for stage in rounds["auto"][0]}
    dearest = sorted(by_stage, key=lambda stage: -by_stage[stage])[:DEAREST]
    cells.append(", ".join(f"{stage} {by_stage[stage]:.2f}" for stage in dearest))
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--flight", type=float, action="append", help="its length, s")
    parser.add_argument("--first-seed", type=int, default=1000)
    given = parser.parse_args()
    print("| flight | VPS | serial, s | joint, s | auto, s | auto ÷ joint | auto ÷ serial | dearest stages, s |")
    print("|---|---|---|---|---|---|---|---|")
    for duration_s in given.flight or [40.0, 200.0]:
        flown = replace(MOVING, duration_s=duration_s, sets=round(SETS_A_SECOND * duration_s))
        every = signals(simulate(flown, seed=given.first_seed))
        without = {name: table for name, table in every.items() if name != "vps"}
        for vps, log in (("without", without), ("with", every)):
            by_method = {method: settings(flown, method=method, lever_arm_m=None) for method in METHODS}
            costs(log, by_method["auto"])  # modules and caches are loaded
            rounds: dict[str, list[Costs]] = defaultdict(list)
            for turn in range(given.rounds):
                for i in range(len(METHODS)):
                    method = METHODS[(turn + i) % len(METHODS)]
                    rounds[method].append(costs(log, by_method[method]))
            print(row(f"{duration_s:.0f} s", vps, rounds), flush=True)


if __name__ == "__main__":
    main()
