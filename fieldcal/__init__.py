"""fieldcal: field calibration of inertial sensors (Grauer et al., AIAA 2009-2064, corrected and extended).

This page fixes the conventions; no other docstring repeats them.

Frames
    n  inertial: north, east, down (NED) at a fixed point.
    b  body: nose, starboard, underside (FRD).
    s  sensor: the triads' own axes, as logged. R_BS turns s into b.
    v  the world of the visual positioning system (VPS).
    Logs in ENU / FLU (ROS) are converted after the sensor model, never before.

Attitude
    Quaternions are (ε1, ε2, ε3, δ): **scalar last** (Eq. 1). A(q) = (δ² − εᵀε)I + 2εεᵀ − 2δS(ε) takes inertial
    components to body components; the same four numbers are SciPy's body-to-inertial rotation.
    q̇ = ½[δI + S(ε); −εᵀ] ω, ω the body rate in body axes (Eq. 10–11). Hemisphere is made continuous before any
    interpolation, smoothing, differentiation or fit metric.

Sensor model (Eq. 5)
    z = Λ z_d + b: z_d the logged number, Λ = diag(λ), in sensor axes. Polarity lives in the sign of λ.
    `zero` = −b/λ in logged units; `zero_bias` = λ d0 + b at a fixed reading d0.

Gravity sign
    "gravity": the accelerometer reads +g on the down axis at rest (the paper). "specific_force": it reads −g there.
    Inside fieldcal's attitude and lever-arm code the accelerometer is always gravity-signed, in body axes.

Arrays
    Rows are samples: (n, 3) vectors, (n, 4) quaternions. Time `t` is float64 seconds from the first sample of the
    log; stamps in tables are int64 nanoseconds. SI units: s, m, rad, m/s², rad/s; magnetic field in the unit of the
    configured reference (T, uT, G, or "norm": units of the local field).
    `segment` numbers contiguous stretches; nothing is interpolated, filtered or integrated across a boundary.

Symbols
    λ, Λ scale · b bias · h field · a acceleration · ω rate · q, ε, δ attitude · f field strength · σ standard
    deviation · ν residual · r_SB lever arm, centre of mass to sensor, body axes · TIC Theil inequality coefficient.
"""

__version__ = "0.1.0"
