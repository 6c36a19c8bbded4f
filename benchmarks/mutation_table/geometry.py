"""Changes in `geometry` that no caller can see."""

from __future__ import annotations

from mutation_table.reasons import ANY_NEGATIVE

EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    (
        "geometry.rotation",
        "cumulative_product",
        "return normalise(multiply(start, padded).transpose(1, 0, 2).reshape(-1, 4)[:n])",
        "1 → 2 #2",
    ): ANY_NEGATIVE,
}
