"""Changes in `estimation.by_velocity` that no caller can see."""

from __future__ import annotations

from mutation_table.reasons import (
    ANY_NEGATIVE,
    CONVERGED,
    DOWN,
    GUARD,
    NEVER_MET,
    SAME_AT_THE_EDGE,
    SAME_MINUS,
    SETTLED,
    START,
)

EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    ("estimation.by_velocity.equations", "solve", "flat = one.theta.reshape(-1, p)", "1 → 2"): ANY_NEGATIVE,
    ("estimation.by_velocity.equations", "solve", "own += flat.T @ weighted.reshape(-1, p)", "1 → 2"): ANY_NEGATIVE,
    (
        "estimation.by_velocity.equations",
        "solve",
        "own_right += flat.T @ drawn.reshape(-1, rights)",
        "1 → 2",
    ): ANY_NEGATIVE,
    ("estimation.by_velocity.equations", "solve", "flat_right = right.reshape(-1, p + rights)", "1 → 2"): ANY_NEGATIVE,
    (
        "estimation.by_velocity.equations",
        "solve",
        "absorbed = flat_right.T @ carried.reshape(-1, p + rights)",
        "1 → 2",
    ): ANY_NEGATIVE,
    (
        "estimation.by_velocity.fit",
        "",
        "UNDAMPED_ITERATIONS, DAMPING = 8, 0.5  # of the levels, which may swing about where they belong",
        "0.5 → 0.55",
    ): DOWN,
    ("estimation.by_velocity.fit", "", "MOST_ITERATIONS = 40", "40 → 44"): CONVERGED,
    (
        "estimation.by_velocity.fit",
        "",
        "ROUGH_ITERATIONS = 4  # while jumps are the start's errors, not noise",
        "4 → 5",
    ): DOWN,
    (
        "estimation.by_velocity.fit",
        "",
        "UNDAMPED_ITERATIONS, DAMPING = 8, 0.5  # of the levels, which may swing about where they belong",
        "8 → 9",
    ): DOWN,
    ("estimation.by_velocity.fit", "", "CONVERGED_SD, CONVERGED_LEVEL = 0.03, 0.03", "0.03 → 0.033"): SETTLED,
    ("estimation.by_velocity.fit", "", "CONVERGED_SD, CONVERGED_LEVEL = 0.03, 0.03", "0.03 → 0.033 #2"): SETTLED,
    ("estimation.by_velocity.fit", "", "START_RATIO = 30.0", "30.0 → 33.0"): START,
    (
        "estimation.by_velocity.levels",
        "robust_weights",
        "distance /= max(float(np.median(distance)), 1e-12) / MEDIAN_LENGTH",
        "1e-12 → 1.1000000000000002e-12",
    ): GUARD,
    ("estimation.by_velocity.levels", "growth", "free = np.maximum(free, 1e-6)", "1e-06 → 1.1e-06"): GUARD,
    (
        "estimation.by_velocity.levels",
        "growth",
        "logarithm = np.minimum((square - free) / information, np.where(square < free, np.log(square / free), np.inf))",
        "< → <=",
    ): SAME_AT_THE_EDGE,
    ("estimation.by_velocity.problem", "place_knots", "if apart < FASTEST_EPOCHS_S:", "< → <="): NEVER_MET,
    (
        "estimation.by_velocity.start",
        "attitudes",
        "attitude = (left * sign[:, None, :]) @ right @ path.turned",
        "* → /",
    ): SAME_MINUS,
    (
        "estimation.by_velocity.equations",
        "solve",
        "drawn[:, r, 1 + group] = np.sqrt(w[:, r]) * sign[:, r]",
        "* → /",
    ): SAME_MINUS,
    (
        "estimation.by_velocity.equations",
        "noise_in_readings",
        "out[first : first + 3] = of_readings * np.where(share < len(jump), share, 0.0) / state.values[name][:3]",
        "< → <=",
    ): NEVER_MET,
    (
        "estimation.by_velocity.equations",
        "solve",
        "scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))",
        "1.0 → 1.1",
    ): "a scale near that of the constants, for the digits alone",
    (
        "estimation.by_velocity.equations",
        "solve",
        "scale = 1.0 / np.sqrt(np.maximum(np.diagonal(total), 1e-300))",
        "1e-300 → 1.1000000000000002e-300",
    ): GUARD,
    (
        "estimation.by_velocity.strapdown",
        "integrate.total",
        "np.cumsum((x[1:] + x[:-1]) * half.reshape(-1, *[1] * (x.ndim - 1)), axis=0, out=out[1:])",
        "1 → 2 #3",
    ): ANY_NEGATIVE,
}
