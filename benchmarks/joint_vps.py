"""What the VPS in the joint estimate (`use_vps`) gains over simulated flights, and whether its sd are honest.

    python benchmarks/joint_vps.py [--flights 32] [--first-seed 1000] [--case clean --case vps …]

The cases are those of `joint_accuracy.py`; one Markdown table, median / 95th percentile over flights, of the joint
estimate without and with the VPS. Scale errors are the rms of three axes, per cent; attitude is the rms angle, degrees,
against the truth delayed by the sensor filter; "NEES" is the mean of (error ÷ sd)² over the nine scales.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from joint_accuracy import CASES, flights_of, measure

from fieldcal.names import SENSORS
from fieldcal.simulation.experiment import simulate

SHOWN = (
    *(f"scale {sensor}" for sensor in SENSORS),
    *(f"zero {sensor}" for sensor in SENSORS),
    "attitude",
    "nees",
    "beyond 3 sd",
    "lag",
    "TIC body rate",
)


def main() -> None:
    given = flights_of(__doc__, CASES).parse_args()
    print(f"{given.flights} flights, seeds from {given.first_seed}; median / 95th percentile\n")
    print("| case | quantity | joint | joint with VPS |\n|---|---|---|---|")
    for case in given.case or list(CASES):
        found: dict[str, list[list[float]]] = defaultdict(lambda: [[], []])
        for seed in range(given.first_seed, given.first_seed + given.flights):
            recording = simulate(CASES[case], seed=seed)
            for column, use_vps in enumerate((False, True)):
                for quantity, value in measure(recording, "joint", use_vps=use_vps):
                    found[quantity][column].append(value)
        for quantity in SHOWN:
            cells = [f"{np.median(x):.3g} / {np.percentile(x, 95):.3g}" if x else "–" for x in found[quantity]]
            if quantity == "beyond 3 sd":
                cells = [f"{100 * np.mean(x):.1f} %" if x else "–" for x in found[quantity]]
            print(f"| {case} | {quantity} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
