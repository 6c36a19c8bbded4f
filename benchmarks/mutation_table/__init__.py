"""What `mutation.py` works on: each module's own tests, and the changes that no caller can see, by room."""

from __future__ import annotations

from collections.abc import Sequence

from mutation_table import by_pose, by_velocity, clock_sync, estimation, exports, geometry, joint, logs, pooled

TESTS: dict[str, Sequence[str]] = {
    "exports": ("exports/test_*.py",),
    "exports.autopilots": (
        "exports/test_a[fu]*.py",
        "exports/test_comparison*.py",
        "exports/test_loading*.py",
        "exports/test_texts*.py",
    ),
    "exports.calibration_at": ("exports/test_calibration_at*.py",),
    "exports.refit": ("exports/test_refit*.py",),
    "geometry": ("geometry/test_*.py",),
    "geometry.earth_field": ("geometry/test_earth_field*.py",),
    "geometry.rotation": ("geometry/test_rotation*.py",),
    "geometry.sensor_model": ("geometry/test_sensor_model*.py",),
    "logs": ("logs/test_logs_csv*.py", "logs/test_logs_[deim]*.py", "logs/test_stamps*.py", "logs/test_tidy*.py"),
    "logs.applied": ("logs/test_logs_autopilot.py", "logs/test_dataflash_*.py", "logs/test_ulog_*.py"),
    "logs.autopilot": ("logs/test_logs_autopilot.py", "logs/test_dataflash_*.py", "logs/test_ulog_*.py"),
    "logs.csv": ("logs/test_csv_*.py", "logs/test_logs_csv*.py"),
    "logs.dataflash": ("logs/test_dataflash_*.py", "logs/test_logs_autopilot.py"),
    "logs.discovery": ("logs/test_logs_discovery*.py",),
    "logs.encodings": ("logs/test_encodings*.py", "logs/test_logs_mcap.py", "logs/test_logs_protobuf.py"),
    "logs.encodings.transforms": ("logs/test_encodings*.py", "logs/test_transforms.py", "logs/test_rosbag1.py"),
    "logs.further_units": ("logs/test_further_units.py", "logs/test_dataflash_*.py"),
    "logs.ingest": ("logs/test_logs_[deim]*.py", "logs/test_mcap_in_the_wild.py"),
    "logs.joining": ("logs/test_logs_autopilot.py", "logs/test_dataflash_*.py", "logs/test_ulog_*.py"),
    "logs.mcap": ("logs/test_mcap_*.py", "logs/test_logs_mcap*.py", "logs/test_logs_protobuf.py"),
    "logs.mcap.chunks": ("logs/test_mcap_chunks.py", "logs/test_mcap_file.py", "logs/test_logs_mcap_damage.py"),
    "logs.messages": (
        "logs/test_mcap_*.py",
        "logs/test_logs_mcap*.py",
        "logs/test_rosbag*.py",
        "logs/test_bag_*.py",
        "logs/test_transforms.py",
    ),
    "logs.rosbag1": ("logs/test_rosbag1*.py", "logs/test_bag_*.py"),
    "logs.rosbag2": ("logs/test_rosbag2*.py", "logs/test_bag_*.py"),
    "logs.stamps": ("logs/test_stamps*.py",),
    "logs.tidy": ("logs/test_tidy*.py", "logs/test_stamps.py"),
    "logs.ulog": ("logs/test_ulog_*.py", "logs/test_logs_autopilot.py"),
    "logs.unpacked": ("logs/test_unpacked*.py",),
    "logs.unread": ("logs/test_unread*.py",),
    "estimation": ("estimation/test_*.py",),
    "estimation.by_pose": ("estimation/by_pose/test_*.py",),
    "estimation.by_velocity": ("estimation/by_velocity/test_*.py",),
    "estimation.clock_sync.by_field": ("estimation/test_clock_by_field*.py",),
    "estimation.clock_sync.by_rates": ("estimation/test_clock_by_rates*.py",),
    "estimation.clock_sync.handedness": ("estimation/test_handedness*.py",),
    "estimation.clock_sync.repeated_poses": ("estimation/test_repeated_poses*.py",),
    "estimation.clock_sync.search": ("estimation/test_clock_search*.py",),
    "estimation.ellipsoid": ("estimation/test_ellipsoid*.py",),
    "estimation.ellipsoid_refusals": ("estimation/test_ellipsoid*.py",),
    "estimation.faults": ("estimation/test_faults*.py",),
    "estimation.gravity_seen": ("estimation/test_gravity_seen*.py",),
    "estimation.gyroscope.equation_error": ("estimation/test_equation_error*.py",),
    "estimation.gyroscope.output_error": ("estimation/test_output_error*.py",),
    "estimation.gyroscope.regressor_noise": ("estimation/test_regressor_noise*.py",),
    "estimation.joint": ("estimation/joint/test_*.py",),
    "estimation.joint.kernel": ("compiled/test_joint_kernel.py",),
    "estimation.motion_selection": ("estimation/test_motion_selection*.py",),
    "estimation.motor_field": ("estimation/test_motor_field*.py",),
    "estimation.normal_equations": ("estimation/test_normal_equations*.py",),
    "estimation.pooled": ("estimation/pooled/test_*.py",),
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

FOR_C = frozenset({"estimation.joint.kernel"})
"""Modules that lay out what the kernel in C reads: it runs in their tests. In all others the NumPy code does, for it is
what is changed."""


EQUIVALENT: dict[tuple[str, str, str, str], str] = {
    **by_pose.EQUIVALENT,
    **by_velocity.EQUIVALENT,
    **clock_sync.EQUIVALENT,
    **estimation.EQUIVALENT,
    **exports.EQUIVALENT,
    **geometry.EQUIVALENT,
    **joint.EQUIVALENT,
    **logs.EQUIVALENT,
    **pooled.EQUIVALENT,
}
"""(module, function or class, the line without its indentation, the change) → why no caller can tell the difference."""
