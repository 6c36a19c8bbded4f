"""Writing DataFlash logs from arrays, as ArduPilot would have recorded them.

    write_dataflash(path, [imu_messages(t_us, gyro_radps, accel_mps2, temperature_degc),
                           mag_messages(t_us, field_g, offsets_mg=(12, -7, 30))],
                    parameters={"INS_GYROFFS_X": 0.01, ...}, texts=["ArduCopter V4.5.7 (0123abcd)"])

Stamps are int64 microseconds since boot of shape (n,), vectors (n, 3). Messages are written in the order of their
stamps, behind the parameters. `as_logged` turns raw readings into those that ArduPilot logs with such parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldcal.logs.dataflash.applied import Temperatures, inertial_corrections, magnetometer_corrections
from fieldcal.logs.dataflash.parameters import Parameters
from fieldcal.logs.dataflash.records import FMT_LAYOUT, FMT_TYPE, LETTERS, LONGEST, MARK

MULTIPLIERS: Mapping[str, float] = {"-": 0.0, "?": 1.0, "0": 1.0, "A": 0.1, "B": 0.01, "C": 1e-3, "F": 1e-6, "G": 1e-7}
"""Multiplier by its letter, as in ArduPilot's MULT messages."""
FIRST_TYPE = 130
HEAD, TYPE = "0xA395", "0x"
"""Names of a message's first bytes, which no column has."""
FREE_TYPES = (*range(FIRST_TYPE, 256), *range(1, FMT_TYPE))
MILLIGAUSS_PER_GAUSS = 1e3


@dataclass(frozen=True)
class Messages:
    """Messages of one type. `letters`: formats of the columns, the first of which is TimeUS.

    `values`: column → (n,) numbers in the unit of the message (a letter c, C, e, E or L takes whole degrees, metres, …)
    or texts; what is not given is zero. `multiplier_ids`: a letter of `MULTIPLIERS` a column.
    """

    name: str
    letters: str
    columns: tuple[str, ...]
    t_us: NDArray[np.int64]
    values: Mapping[str, ArrayLike]
    multiplier_ids: str = ""

    @property
    def dtype(self) -> np.dtype[np.void]:
        """A message as it is stored: head, then the columns packed."""
        fields = [(name, LETTERS[letter].dtype) for name, letter in zip(self.columns, self.letters, strict=True)]
        return np.dtype([(HEAD, "S2"), (TYPE, "u1"), *fields])

    def packed(self, type_id: int) -> NDArray[np.uint8]:
        """The messages as bytes, (n, size). Raises ValueError where numbers do not fit their format."""
        rows = np.zeros(len(self.t_us), self.dtype)
        rows[HEAD], rows[TYPE], rows[self.columns[0]] = MARK, type_id, self.t_us
        for name, given in self.values.items():
            letter = LETTERS[self.letters[self.columns.index(name)]]
            numbers = np.asarray(given)
            if letter.divisor is not None:
                numbers = np.round(numbers * letter.divisor)
            if letter.dtype.kind in "iu" and numbers.size:
                limits = np.iinfo(letter.dtype.base)
                if numbers.min() < limits.min or numbers.max() > limits.max:
                    raise ValueError(f"{self.name}.{name} does not fit format {self.letters[self.columns.index(name)]}")
            rows[name] = numbers
        return rows.view(np.uint8).reshape(len(rows), self.dtype.itemsize)


def imu_messages(
    t_us: ArrayLike,
    gyroscope_radps: ArrayLike,
    accelerometer_mps2: ArrayLike,
    temperature_degc: ArrayLike = 0.0,
    *,
    instance: int = 0,
) -> Messages:
    """IMU as firmware since 4.1 has it: rates (n, 3), specific force (n, 3), temperature (n,) or one; float32."""
    values: dict[str, ArrayLike] = {"I": instance, "T": temperature_degc, "GH": 1, "AH": 1}
    values |= _columns("Gyr", gyroscope_radps) | _columns("Acc", accelerometer_mps2)
    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    return _messages("IMU", "QBffffffIIfBBHH", columns, t_us, values, "F-000000--0----")


def raw_messages(
    sensor: str, t_us: ArrayLike, sample_us: ArrayLike, vectors: ArrayLike, *, instance: int = 0
) -> Messages:
    """ACC or GYR (`sensor`): readings before the low-pass, (n, 3), and when they were sampled."""
    stem = sensor.capitalize()
    values = {"I": instance, "SampleUS": sample_us, **_columns(stem, vectors)}
    return _messages(sensor, "QBQfff", f"TimeUS,I,SampleUS,{stem}X,{stem}Y,{stem}Z", t_us, values, "F-F000")


def mag_messages(
    t_us: ArrayLike,
    magnetometer_g: ArrayLike,
    *,
    offsets_mg: ArrayLike = (0.0, 0.0, 0.0),
    motors_mg: ArrayLike = (0.0, 0.0, 0.0),
    sample_us: ArrayLike | None = None,
    instance: int = 0,
) -> Messages:
    """MAG: the field (n, 3), G, offsets and the motors' part (3,) or (n, 3), mG, all cut to whole mG."""
    stamps = _stamps(t_us)
    field_mg = np.trunc(np.round(np.asarray(magnetometer_g, float) * MILLIGAUSS_PER_GAUSS, 6))
    values: dict[str, ArrayLike] = {"I": instance, "Health": 1, **_columns("Mag", field_mg)}
    for stem, given in (("Ofs", offsets_mg), ("MO", motors_mg)):
        values |= _columns(stem, np.broadcast_to(np.trunc(np.asarray(given, float)), (len(stamps), 3)))
    values["S"] = (stamps if sample_us is None else _stamps(sample_us)) % (1 << 32)
    columns = "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"
    return _messages("MAG", "QBhhhhhhhhhBI", columns, stamps, values, "F-CCCCCCCCC-F")


def gps_messages(
    t_us: ArrayLike,
    gps_week: ArrayLike,
    gps_ms: ArrayLike,
    position: ArrayLike,
    velocity_ned_mps: ArrayLike,
    *,
    status: ArrayLike = 3,
) -> Messages:
    """GPS: GPS time (n,), latitude, longitude, degrees, and altitude, m, (n, 3), velocity (n, 3)."""
    where, velocity = np.asarray(position, float), np.asarray(velocity_ned_mps, float)
    values: dict[str, ArrayLike] = {"Status": status, "GWk": gps_week, "GMS": gps_ms, "NSats": 12, "U": 1}
    values |= {"Lat": where[:, 0], "Lng": where[:, 1], "Alt": where[:, 2]}
    values["Spd"] = np.hypot(velocity[:, 0], velocity[:, 1])
    values["GCrs"] = np.rad2deg(np.arctan2(velocity[:, 1], velocity[:, 0])) % 360.0
    values["VZ"] = velocity[:, 2]
    columns = "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U"
    return _messages("GPS", "QBBIHBcLLeffffB", columns, t_us, values, "F--C-0BGGB0000-")


def gpa_messages(t_us: ArrayLike, speed_accuracy_mps: ArrayLike) -> Messages:
    """GPA: the receiver's accuracy of speed, (n,)."""
    columns = "TimeUS,I,VDop,HAcc,VAcc,SAcc,YAcc,VV,SMS,Delta"
    values = {"SAcc": speed_accuracy_mps, "VV": 1}
    return _messages("GPA", "QBCCCCfBIH", columns, t_us, values, "F-BBBB0-CF")


def vision_messages(
    t_us: ArrayLike, position_m: ArrayLike, roll_pitch_yaw_deg: ArrayLike, taken_ms: ArrayLike | None = None
) -> Messages:
    """VISP: pose of external vision, (n, 3) north-east-down and (n, 3), and when it was taken."""
    taken = _stamps(t_us) // 1000 if taken_ms is None else taken_ms
    angles = np.asarray(roll_pitch_yaw_deg, float)
    values = {"CTimeMS": taken, **_columns("P", position_m)}
    values |= {name: angles[:, i] for i, name in enumerate(("Roll", "Pitch", "Yaw"))}
    columns = "TimeUS,RTimeUS,CTimeMS,PX,PY,PZ,Roll,Pitch,Yaw,PErr,AErr,Rst,Ign"
    return _messages("VISP", "QQIffffffffBB", columns, t_us, values, "FFC00000000--")


def battery_messages(t_us: ArrayLike, current_a: ArrayLike) -> Messages:
    """BAT: current, (n,)."""
    columns = "TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Temp,Res"
    return _messages("BAT", "QBfffffcf", columns, t_us, {"Curr": current_a}, "F-000?0B0")


def text_messages(t_us: ArrayLike, texts: Sequence[str]) -> Messages:
    """MSG: what the autopilot says, 64 bytes at most."""
    return _messages(
        "MSG", "QZ", "TimeUS,Message", t_us, {"Message": np.array([t.encode() for t in texts], "S64")}, "F-"
    )


def parameter_messages(t_us: ArrayLike, names: Sequence[str], values: ArrayLike) -> Messages:
    """PARM: parameters, 16 bytes of name at most, and their values, float32."""
    given = {"Name": np.array([name.encode() for name in names], "S16"), "Value": values}
    return _messages("PARM", "QNf", "TimeUS,Name,Value", t_us, given, "F--")


def write_dataflash(
    path: Path,
    messages: Sequence[Messages],
    *,
    parameters: Mapping[str, float] | None = None,
    texts: Sequence[str] = (),
    self_described: bool = True,
) -> None:
    """Write a log. Several series of one name (instances, changed parameters) share its type.

    `self_described`: with FMTU and MULT messages, as firmware since 3.6 writes them.
    """
    begin_us = min((int(series.t_us.min()) for series in messages if len(series.t_us)), default=0)
    stated = dict(parameters or {})
    head = [
        text_messages(np.full(len(texts), begin_us), texts),
        parameter_messages(np.full(len(stated), begin_us), list(stated), list(stated.values())),
    ]
    series = [*head, *messages]
    kinds = {one.name: one for one in series}
    types = dict(zip(kinds, FREE_TYPES, strict=False))
    with path.open("wb") as stream:
        stream.write(_definitions(kinds, types, begin_us, self_described))
        blocks = [one.packed(types[one.name]) for one in series]
        stamps = np.concatenate([one.t_us for one in series])
        sizes = np.concatenate([np.full(len(block), block.shape[1]) for block in blocks])
        order = np.argsort(stamps, kind="stable")
        starts = np.empty(len(order), np.int64)
        starts[order] = np.cumsum(sizes[order]) - sizes[order]
        content = np.empty(int(sizes.sum()), np.uint8)
        done = 0
        for block in blocks:
            places = starts[done : done + len(block), None] + np.arange(block.shape[1])
            content[places] = block
            done += len(block)
        stream.write(content.tobytes())


def as_logged(
    sensor: str,
    raw: ArrayLike,
    parameters: Mapping[str, float],
    *,
    slot: int = 0,
    temperature_degc: ArrayLike = 35.0,
) -> NDArray[np.float64]:
    """Raw readings (n, 3) of `sensor` "GYR", "ACC" or "MAG" (rad/s, m/s², G) as ArduPilot logs them with `parameters`.

    `temperature_degc`: (n,) or one.
    """
    readings = np.asarray(raw, float)
    held = Parameters.of(parameters)
    if sensor == "MAG":
        corrections = magnetometer_corrections(slot, held, np.zeros(1, np.int64), None)
        return np.asarray(readings @ np.array(corrections[0].matrix).T + corrections[0].offset)
    logged = np.empty_like(readings)
    for degc in np.unique(temperatures := np.broadcast_to(np.asarray(temperature_degc, float), len(readings))):
        at = Temperatures(np.zeros(1, np.int64), np.array([degc]))
        correction = inertial_corrections(sensor, slot, held, 0, at)[0]
        rows = temperatures == degc
        logged[rows] = readings[rows] @ np.array(correction.matrix).T + correction.offset
    return logged


def _definitions(kinds: Mapping[str, Messages], types: Mapping[str, int], t_us: int, self_described: bool) -> bytes:
    """FMT messages of FMT itself and of all kinds, then MULT and FMTU."""
    stamp = np.array([t_us], np.int64)
    said: dict[str, Messages] = dict(kinds)
    described: list[tuple[Messages, int]] = []
    if self_described:
        spare = iter(type_id for type_id in FREE_TYPES if type_id not in types.values())
        mult_type, fmtu_type = next(spare), next(spare)
        letters = list(MULTIPLIERS)
        mult = _messages(
            "MULT",
            "Qbd",
            "TimeUS,Id,Mult",
            np.repeat(stamp, len(letters)),
            {"Id": [ord(letter) for letter in letters], "Mult": [MULTIPLIERS[letter] for letter in letters]},
        )
        named = [(types[name], one.multiplier_ids) for name, one in kinds.items() if one.multiplier_ids]
        fmtu = _messages(
            "FMTU",
            "QBNN",
            "TimeUS,FmtType,UnitIds,MultIds",
            np.repeat(stamp, len(named)),
            {"FmtType": [t for t, _ in named], "MultIds": np.array([ids.encode() for _, ids in named], "S16")},
        )
        said |= {"MULT": mult, "FMTU": fmtu}
        types = {**types, "MULT": mult_type, "FMTU": fmtu_type}
        described = [(mult, mult_type), (fmtu, fmtu_type)]
    parts = [_fmt(FMT_TYPE, FMT_LAYOUT.size, "FMT", FMT_LAYOUT.letters, FMT_LAYOUT.columns)]
    parts += [_fmt(types[n], one.dtype.itemsize, n, one.letters, one.columns) for n, one in said.items()]
    parts += [one.packed(type_id).tobytes() for one, type_id in described]
    return b"".join(parts)


def _fmt(type_id: int, size: int, name: str, letters: str, columns: Sequence[str]) -> bytes:
    listed = ",".join(columns).encode()
    if size > LONGEST or len(name) > 4 or len(letters) > 16 or len(listed) > 64:
        raise ValueError(f"message {name} does not fit the format: 255 bytes, 4 of name, 16 columns, 64 of their names")
    head = MARK + bytes([FMT_TYPE, type_id, size])
    return head + name.encode().ljust(4, b"\0") + letters.encode().ljust(16, b"\0") + listed.ljust(64, b"\0")


def _messages(
    name: str, letters: str, columns: str, t_us: ArrayLike, values: Mapping[str, ArrayLike], multiplier_ids: str = ""
) -> Messages:
    return Messages(name, letters, tuple(columns.split(",")), _stamps(t_us), values, multiplier_ids)


def _stamps(t_us: ArrayLike) -> NDArray[np.int64]:
    return np.asarray(t_us, np.int64)


def _columns(stem: str, vectors: ArrayLike) -> dict[str, ArrayLike]:
    values = np.asarray(vectors, float)
    return {f"{stem}{axis}": values[:, i] for i, axis in enumerate("XYZ")}
