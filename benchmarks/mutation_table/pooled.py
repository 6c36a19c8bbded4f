"""Changes in `estimation.pooled` that no caller can see."""

from __future__ import annotations

from mutation_table.reasons import ANY_NEGATIVE, GUARD, NEVER_MET, RCOND, SAME_AT_THE_EDGE, SETTLED, START

EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    ("estimation.pooled.chain", "Known.estimate", "seen = value > UNSEEN", "> → >="): NEVER_MET,
    (
        "estimation.pooled.strengths",
        "",
        'TOLERANCES = {"fatol": 0.01, "xatol": 0.02}',
        "0.01 → 0.011000000000000001",
    ): SETTLED,
    (
        "estimation.pooled.strengths",
        "",
        'TOLERANCES = {"fatol": 0.01, "xatol": 0.02}',
        "0.02 → 0.022000000000000002",
    ): SETTLED,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "0.2 → 0.22000000000000003",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "0.4 → 0.44000000000000006",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "0.5 → 0.55",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "1.0 → 1.1",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "4.0 → 4.4",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "16.0 → 17.6",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "64.0 → 70.4",
    ): START,
    (
        "estimation.pooled.strengths",
        "",
        "START, TIMES = (0.2, 0.4, 0.5), (1.0, 4.0, 16.0, 64.0, 256.0)",
        "256.0 → 281.6",
    ): START,
    (
        "estimation.pooled.strengths",
        "innovations",
        "usual = here & started & (error**2 < RESTART_SD**2 * s)",
        "< → <=",
    ): NEVER_MET,
    ("estimation.pooled.strengths", "_starts", "times = TIMES if with_slope else TIMES[:1]", "1 → 2"): START,
    (
        "estimation.pooled.strengths",
        "unlikely",
        "return float(above if above > 0.0 else FEW * (above + EXPECTED_SHARE**2 / ratio - 1.0))",
        "> → >=",
    ): SAME_AT_THE_EDGE,
    (
        "estimation.pooled.unit",
        "_worst_flight",
        "if len(sessions) < FEWEST_TO_CONTRADICT or len(out) + 1 > max(1.0, LARGEST_LEFT_OUT * len(flights)):",
        "1.0 → 1.1",
    ): "counts are whole",
    (
        "estimation.pooled.unit",
        "Pooled.rates",
        "size = np.sqrt(np.maximum(np.diagonal(n)[:d], 1e-300))",
        "1e-300 → 1.1000000000000002e-300",
    ): GUARD,
    (
        "estimation.pooled.unit",
        "Pooled.rates",
        "inverse = np.linalg.pinv(n[:d, :d] / np.outer(size, size), rcond=1e-10, hermitian=True)",
        "1e-10 → 1.1000000000000001e-10",
    ): RCOND,
    (
        "estimation.pooled.unit",
        "Pooled.rates",
        "if information[i] > 1e-9 * alone[i]:",
        "1e-09 → 1.1000000000000001e-09",
    ): RCOND,
    (
        "estimation.pooled.unit",
        "Pooled.last_z",
        "known = np.isfinite(gained) & (gained > LEAST_SHARE * variance)",
        "> → >=",
    ): NEVER_MET,
    (
        "estimation.pooled.unit",
        "_worst_flight",
        "certain = chance[worst] < np.log(FALSE_ALARMS / len(flights))",
        "< → <=",
    ): NEVER_MET,
    (
        "estimation.pooled.unit",
        "contradiction",
        "size = np.sqrt(np.maximum(np.diagonal(own.information), 1e-300))",
        "1e-300 → 1.1000000000000002e-300",
    ): GUARD,
    ("estimation.pooled.unit", "contradiction", "seen = value > 1e-9", "> → >="): NEVER_MET,
    ("estimation.pooled.unit", "contradiction", "seen = value > 1e-9", "1e-09 → 1.1000000000000001e-09"): RCOND,
    ("estimation.pooled.unit", "contradiction", "testable = spread < UNTESTABLE", "< → <="): NEVER_MET,
    (
        "estimation.pooled.unit",
        "surest_step",
        "if not chance[row, i] < np.log(FALSE_ALARMS / z.size):",
        "< → <=",
    ): NEVER_MET,
    (
        "estimation.pooled.unit",
        "surest_drift",
        "if abs(rate.per_day) * length > np.sqrt(found.scatter[place])",
        "> → >=",
    ): NEVER_MET,
    (
        "estimation.pooled.unit",
        "surest_drift",
        "return surest if surest is not None and surest[0] < np.log(FALSE_ALARMS / len(found.names)) else None",
        "< → <=",
    ): NEVER_MET,
    (
        "estimation.pooled.unit",
        "jumps",
        "size = np.sqrt(np.maximum(np.diagonal(together.information), 1e-300))",
        "1e-300 → 1.1000000000000002e-300",
    ): GUARD,
    (
        "estimation.pooled.unit",
        "jumps",
        "inverse = np.linalg.pinv(together.information / np.outer(size, size), rcond=1e-10, hermitian=True)",
        "1e-10 → 1.1000000000000001e-10",
    ): RCOND,
    (
        "estimation.pooled.unit",
        "jumps",
        "information = np.where(information > 1e-9 * np.maximum(full, 1e-300), information, 0.0)",
        "1e-09 → 1.1000000000000001e-09",
    ): RCOND,
    (
        "estimation.pooled.unit",
        "jumps",
        "information = np.where(information > 1e-9 * np.maximum(full, 1e-300), information, 0.0)",
        "1e-300 → 1.1000000000000002e-300",
    ): GUARD,
    (
        "estimation.pooled.unit",
        "series_of_sessions",
        "return [np.array(own).reshape(-1, 4) for own in rows]",
        "1 → 2",
    ): ANY_NEGATIVE,
    (
        "estimation.pooled.unit",
        "within_sessions",
        "return [np.array(own).reshape(-1, 3) for own in pairs]",
        "1 → 2",
    ): ANY_NEGATIVE,
    (
        "estimation.pooled.unit",
        "jumps",
        "information = np.where(information > 1e-9 * np.maximum(full, 1e-300), information, 0.0)",
        "> → >=",
    ): NEVER_MET,
}
