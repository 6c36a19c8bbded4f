"""What `mutation.py` works on: each module's own tests, and the changes that no caller can see."""

from __future__ import annotations

from collections.abc import Sequence

TESTS: dict[str, Sequence[str]] = {
    "exports": ("exports/test_*.py",),
    "geometry": ("geometry/test_*.py",),
    "geometry.earth_field": ("geometry/test_earth_field*.py",),
    "geometry.rotation": ("geometry/test_rotation*.py",),
    "geometry.sensor_model": ("geometry/test_sensor_model*.py",),
    "logs": ("logs/test_logs_csv*.py", "logs/test_logs_[dem]*.py", "logs/test_stamps*.py", "logs/test_tidy*.py"),
    "logs.csv": ("logs/test_csv_*.py", "logs/test_logs_csv*.py"),
    "logs.encodings": ("logs/test_encodings*.py", "logs/test_logs_mcap.py", "logs/test_logs_protobuf.py"),
    "logs.mcap": ("logs/test_mcap_*.py", "logs/test_logs_mcap*.py", "logs/test_logs_protobuf.py"),
    "logs.mcap.chunks": ("logs/test_mcap_chunks.py",),
    "logs.stamps": ("logs/test_stamps*.py",),
    "logs.tidy": ("logs/test_tidy*.py", "logs/test_stamps.py"),
    "estimation": ("estimation/test_*.py",),
    "estimation.clock_sync.by_field": ("estimation/test_clock_by_field*.py",),
    "estimation.clock_sync.by_rates": ("estimation/test_clock_by_rates*.py",),
    "estimation.ellipsoid": ("estimation/test_ellipsoid*.py",),
    "estimation.ellipsoid_refusals": ("estimation/test_ellipsoid*.py",),
    "estimation.faults": ("estimation/test_faults*.py",),
    "estimation.gyroscope.equation_error": ("estimation/test_equation_error*.py",),
    "estimation.gyroscope.output_error": ("estimation/test_output_error*.py",),
    "estimation.gyroscope.regressor_noise": ("estimation/test_regressor_noise*.py",),
    "estimation.joint": ("estimation/joint/test_*.py",),
    "estimation.motion_selection": ("estimation/test_motion_selection*.py",),
    "estimation.motor_field": ("estimation/test_motor_field*.py",),
    "estimation.quadric": ("estimation/test_quadric*.py",),
    "estimation.robust": ("estimation/test_robust*.py",),
    "estimation.segments": ("estimation/test_segments*.py",),
    "estimation.smoothing": ("estimation/test_smoothing*.py",),
    "estimation.statistics": ("estimation/test_statistics*.py",),
    "estimation.theil": ("estimation/test_theil*.py",),
    "estimation.uncertainty_propagation": ("estimation/test_output_error.py", "estimation/test_regressor_noise.py"),
    "estimation.wahba": ("estimation/test_wahba*.py",),
    "estimation.warm_up": ("estimation/test_warm_up*.py",),
}
"""Module, or room of modules, below fieldcal → its own tests below tests/. The longest name counts; a module of the
four rooms that has no line of its own is held to all tests of its room."""

_AT_A_TIME = "how much is worked on at a time; the result is the same"
_ROOM = "room that is filled up to `filled`, which is what is returned"
_LENGTH = "a transform may be longer than what it transforms"
_ANY_NEGATIVE = "NumPy takes any negative length for the one that is left over"
_REFUSED_NEXT = "what the bound lets pass is refused by the end of the last message, two checks on"
_SPARE_SAMPLES = "spare samples of the padding lie beyond the filter's reach"
_THREE_TAKEN = "columns_of takes the three of the axes"
_SAME_MINUS = "to divide by -1 is to multiply by it"
_LOOKED_AT = "how far is looked; a file is written one way from its first lines on"
_OVER_ZEROS = "zeros over anything are zeros"
_GUARD = "any small number guards the division as well"
_WIDTHS = "values are 1, 3 or 4 numbers wide"
_SAME_AT_THE_EDGE = "both forms give the same where they meet"
_NEVER_MET = "real numbers do not meet there"
_CONVERGED = "Gauss and Newton converge quadratically: a step more or less moves nothing that is seen"

EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    (
        "estimation.smoothing",
        "low_pass",
        "before, after = x[side:0:-1], x[-2 : -side - 2 : -1]",
        "2 → 3",
    ): _SPARE_SAMPLES,
    (
        "estimation.smoothing",
        "low_pass",
        "size = fft.next_fast_len(len(padded) + 2 * side, real=True)",
        "True → False",
    ): _LENGTH,
    (
        "estimation.smoothing",
        "low_pass",
        "size = fft.next_fast_len(len(padded) + 2 * side, real=True)",
        "2 → 3",
    ): _LENGTH,
    ("estimation.smoothing", "low_pass", "shape = (-1,) + (1,) * (x.ndim - 1)", "1 → 2"): _ANY_NEGATIVE,
    (
        "exports.apply",
        "write_parquet",
        "values = c.readings[name][1] if name in own else np.full((len(t_ns), 3), np.nan)",
        "3 → 4",
    ): _THREE_TAKEN,
    (
        "exports.apply",
        "write_ros",
        "nothing = np.full((len(either[0]), 3), np.nan)",
        "0 → 1",
    ): "stamps and readings are equally many",
    (
        "exports.apply",
        "_temperature_at",
        'origin = int(known["t_ns"][0])',
        "0 → 1",
    ): "an origin near the stamps, for the digits alone",
    (
        "logs.mcap.chunks",
        "",
        "ZSTD_WINDOW_CAP_BYTES = 128 << 20",
        "<< → >>",
    ): "0 stands for Zstandard's own cap: the same",
    (
        "logs.mcap.chunks",
        "",
        "ZSTD_WINDOW_CAP_BYTES = 128 << 20",
        "128 → 140",
    ): "the next window that a frame can name has 144 MiB",
    ("logs.mcap.chunks", "", "_PIECE_BYTES = 1 << 20", "1 → 2"): _AT_A_TIME,
    ("logs.mcap.chunks", "", "_PIECE_BYTES = 1 << 20", "20 → 22"): _AT_A_TIME,
    ("logs.mcap.chunks", "", "_FED_BYTES = 1 << 16", "1 → 2"): _AT_A_TIME,
    ("logs.mcap.chunks", "", "_FED_BYTES = 1 << 16", "16 → 17"): _AT_A_TIME,
    ("logs.mcap.chunks", "_lz4", "content, filled, position = bytearray(size + 1), 0, 0", "1 → 2"): _ROOM,
    ("logs.mcap.chunks", "_lz4", "content, filled, position = bytearray(size + 1), 0, 0", "+ → -"): _ROOM,
    ("logs.mcap.chunks", "_lz4", "content[filled : filled + len(piece)] = piece", "+ → -"): _ROOM,
    ("logs.mcap.chunks", "_hinted", "room = data.size - HEAD_BYTES - MESSAGE_HEAD_BYTES", "- → +"): _REFUSED_NEXT,
    (
        "logs.mcap.chunks",
        "_hinted",
        "if np.any(data[starts] != MESSAGE) or int(sizes.max()) > data.size or int(sizes.min()) < MESSAGE_HEAD_BYTES:",
        "> → >=",
    ): _REFUSED_NEXT,
    (
        "logs.mcap.chunks",
        "_zstd",
        "reader = decompressor.stream_reader(packed, read_across_frames=True)",
        "True → False",
    ): "the loop reads on behind the end of a frame, until nothing comes",
    ("logs.tidy", "", "MOST_INTERVALS = 1 << 20", "1 → 2"): _AT_A_TIME,
    ("logs.tidy", "", "MOST_INTERVALS = 1 << 20", "20 → 22"): _AT_A_TIME,
    ("logs.tidy", "TidySignal._account", "while self._intervals.size > MOST_INTERVALS:", "> → >="): _AT_A_TIME,
    (
        "logs.tidy",
        "TidySignal.__init__",
        "self._n_late = 0",
        "0 → 1",
    ): "the first stamp of all is behind none, which begins the count anew",
    (
        "logs.tidy",
        "TidySignal._account",
        "self.longest_gap_ns = max(self.longest_gap_ns, int(intervals.max(initial=0)))",
        "0 → 1",
    ): "told from a second on",
    ("logs.stamps", "", "AT_ONCE = 1 << 17", "1 → 2"): _AT_A_TIME,
    ("logs.stamps", "", "AT_ONCE = 1 << 17", "17 → 18"): _AT_A_TIME,
    (
        "estimation.quadric",
        "triad_of_quadric",
        "if np.trace(q) < 0:",
        "< → <=",
    ): "a trace of 0 has an eigenvalue of 0 or less, which is refused",
    (
        "estimation.quadric",
        "total_least_squares",
        "norms[norms == 0.0] = 1.0  # a stuck axis has none",
        "1.0 → 1.1",
    ): _OVER_ZEROS,
    (
        "estimation.quadric",
        "total_least_squares",
        "theta = np.linalg.svd(d / norms, full_matrices=False)[2][-1] / norms",
        "False → True",
    ): "the rows of Vt are the same",
    (
        "estimation.quadric",
        "sphere",
        "if rank < 4 or radius_squared <= 0:",
        "<= → <",
    ): "a radius of 0 has a rank below 4",
    (
        "estimation.statistics",
        "huber_weights",
        "return np.where(magnitude > limit, limit / np.maximum(magnitude, limit), 1.0)",
        "> → >=",
    ): _SAME_AT_THE_EDGE,
    (
        "estimation.statistics",
        "_coloured",
        "size = fft.next_fast_len(n + lags + 1, real=True)  # no wrap-around within the lags that the taper keeps",
        "1 → 2",
    ): _LENGTH,
    (
        "estimation.statistics",
        "_coloured",
        "size = fft.next_fast_len(n + lags + 1, real=True)  # no wrap-around within the lags that the taper keeps",
        "True → False",
    ): _LENGTH,
    (
        "estimation.statistics",
        "independent_samples",
        "return _coloured(np.zeros((len(r), 1, 0)), r[:, None])[1]",
        "0 → 1",
    ): "only the second result is taken",
    ("estimation.statistics", "least_squares_covariance", "scale[scale == 0.0] = 1.0", "1.0 → 1.1"): _OVER_ZEROS,
    (
        "estimation.statistics",
        "least_squares_covariance",
        "inverse = np.linalg.pinv((flat / scale).T @ (flat / scale), hermitian=True) / np.outer(scale, scale)",
        "True → False",
    ): "another algorithm for the same inverse",
    (
        "estimation.statistics",
        "least_squares_covariance",
        "freedom = min(independent / max(independent - (p + nuisance) / channels, 1e-9), 4.0)",
        "1e-09 → 1.1000000000000001e-09",
    ): "the cap of 4 holds long before",
    (
        "estimation.theil",
        "theil",
        "cross = np.mean((z - z.mean(axis=0)) * (y - y.mean(axis=0)), axis=0)",
        "- → +",
    ): "the other factor's mean is 0",
    (
        "estimation.theil",
        "theil",
        "cross = np.mean((z - z.mean(axis=0)) * (y - y.mean(axis=0)), axis=0)",
        "- → + #2",
    ): "the other factor's mean is 0",
    ("estimation.theil", "theil_attitude", "y[np.sum(z * y, axis=1) < 0] *= -1.0", "* → /"): _SAME_MINUS,
    ("estimation.theil", "theil_attitude", "y[np.sum(z * y, axis=1) < 0] *= -1.0", "< → <="): _NEVER_MET,
    (
        "logs.encodings.protobuf_messages",
        "ProtobufDecoder._resolved",
        "if len(paths) == 1 and want.width > 1:",
        "1 → 2 #2",
    ): _WIDTHS,
    (
        "logs.encodings.ros2_cdr",
        "",
        '_ENCAPSULATIONS = {0x0000: (">", 8), 0x0100: ("<", 8), 0x0600: (">", 4), 0x0700: ("<", 4)}',
        "8 → 9",
    ): "no number is longer than 8 bytes",
    (
        "logs.encodings.ros2_cdr",
        "",
        '_ENCAPSULATIONS = {0x0000: (">", 8), 0x0100: ("<", 8), 0x0600: (">", 4), 0x0700: ("<", 4)}',
        "8 → 9 #2",
    ): "no number is longer than 8 bytes",
    (
        "logs.encodings.ros2_cdr",
        "CdrDecoder.decode",
        "kept = np.flatnonzero(sizes >= ENCAPSULATION_BYTES)",
        ">= → >",
    ): "nothing that is wanted fits into no bytes",
    (
        "logs.encodings.ros2_cdr",
        "CdrDecoder._variable",
        "_require(cursor + 4, limits)",
        "4 → 5",
    ): "what is wanted stands behind and has a byte at least",
    (
        "logs.encodings.ros2_cdr",
        "_in_order",
        'empty = {name: np.empty((0, w) if w > 1 else 0) for name, w in widths.items() if name not in ("sec", "nanosec")}',
        "1 → 2",
    ): _WIDTHS,
    (
        "logs.encodings.ros2_cdr",
        "_in_order",
        "values = {name: np.concatenate([part.values[name] for part in parts])[order] for name in parts[0].values}",
        "0 → 1",
    ): "all parts hold the same values",
    ("logs.csv.dialect", "", "_LINES_LOOKED_AT = 50", "50 → 55"): _LOOKED_AT,
    (
        "logs.csv.dialect",
        "find_dialect",
        'lines = block.split(b"\\n", _LINES_LOOKED_AT * 4)[: _LINES_LOOKED_AT * 4]',
        "4 → 5",
    ): _LOOKED_AT,
    (
        "logs.csv.dialect",
        "find_dialect",
        'lines = block.split(b"\\n", _LINES_LOOKED_AT * 4)[: _LINES_LOOKED_AT * 4]',
        "4 → 5 #2",
    ): _LOOKED_AT,
    ("logs.csv.reader", "", "_LINES_LOOKED_AT = 50", "50 → 55"): _LOOKED_AT,
    (
        "logs.csv.rows",
        "Losses.add",
        "new = lines if last is None else np.setdiff1d(lines, last, assume_unique=True)",
        "True → False",
    ): "line numbers are unique: it spares a sort",
    (
        "logs.csv.rows",
        "_silent",
        "for line in np.flatnonzero((ends - starts < 64) & blank & ~silent).tolist():",
        "& → |",
    ): "which lines are looked at one by one; the result is the same",
    (
        "logs.csv.rows",
        "_silent",
        "for line in np.flatnonzero((ends - starts < 64) & blank & ~silent).tolist():",
        "64 → 70",
    ): "no logger writes lines of that many blanks",
    ("logs.csv.text", "", "BLOCK_BYTES = 4 << 20", "4 → 5"): _AT_A_TIME,
    ("logs.csv.text", "", "BLOCK_BYTES = 4 << 20", "20 → 22"): _AT_A_TIME,
    ("logs.csv.text", "", "_PROBE_BYTES = 4096", "4096 → 4505"): _LOOKED_AT,
    (
        "logs.csv.text",
        "LineBlocks.__init__",
        "self.unterminated = False",
        "False → True",
    ): "told once iterated, which sets it anew",
    (
        "logs.mcap.report",
        "Tally.forget_cut",
        "places = max(self.damaged_chunks, self.damaged_records, key=lambda damage: damage[-1][0] if damage else -1)",
        "1 → 2 #2",
    ): "before every place",
    (
        "estimation.clock_sync.by_rates",
        "correlate",
        "overlap = np.maximum(cross(ma, mb), 1e-9)",
        "1e-09 → 1.1000000000000001e-09",
    ): _GUARD,
    (
        "estimation.clock_sync.by_rates",
        "correlate",
        "floor = max(1e-6 * float(np.sum(a * a)) * float(np.sum(b * b)), 1e-300)",
        "1e-300 → 1.1000000000000002e-300",
    ): _GUARD,
    (
        "estimation.clock_sync.by_rates",
        "mask_outliers",
        "worst = bad & (score >= np.r_[0.0, score[:-1]]) & (score >= np.r_[score[1:], 0.0])",
        "0.0 → 1.0",
    ): "an end that is suspect has an infinite score",
    (
        "estimation.clock_sync.by_rates",
        "mask_outliers",
        "worst = bad & (score >= np.r_[0.0, score[:-1]]) & (score >= np.r_[score[1:], 0.0])",
        "0.0 → 1.0 #2",
    ): "an end that is suspect has an infinite score",
    (
        "estimation.clock_sync.by_rates",
        "correlate",
        "floor = max(1e-6 * float(np.sum(a * a)) * float(np.sum(b * b)), 1e-300)",
        "1e-06 → 1.1e-06",
    ): _GUARD,
    (
        "estimation.clock_sync.by_rates",
        "_refine",
        "if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:",
        "and → or",
    ): _CONVERGED,
    (
        "estimation.clock_sync.by_rates",
        "_refine",
        "if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:",
        "1e-09 → 1.1000000000000001e-09",
    ): _CONVERGED,
    (
        "estimation.clock_sync.by_rates",
        "_refine",
        "if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:",
        "1e-10 → 1.1000000000000001e-10",
    ): _CONVERGED,
    (
        "estimation.clock_sync.by_rates",
        "_refine",
        "if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:",
        "< → <=",
    ): _NEVER_MET,
    (
        "estimation.clock_sync.by_rates",
        "_refine",
        "if abs(step[0]) < 1e-9 and abs(step[1]) < 1e-10:",
        "< → <= #2",
    ): _NEVER_MET,
    ("estimation.clock_sync.by_rates", "_refine", "for _ in range(12):", "12 → 13"): _CONVERGED,
    ("estimation.clock_sync.by_field", "", "MAX_ITERATIONS = 12", "12 → 13"): _CONVERGED,
}
"""(module, function or class, the line without its indentation, the change) → why no caller can tell the difference."""
