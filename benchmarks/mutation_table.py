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
    "estimation.clock_sync": ("estimation/test_clock_*.py",),
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
}
"""(module, function or class, the line without its indentation, the change) → why no caller can tell the difference."""
