"""The configuration file: what it may say, how it merges, and what is said of mistakes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fieldcal.config.configuration import Alerts, LocalField, load, parse
from fieldcal.config.parameters import Parameters
from fieldcal.errors import ConfigurationError
from fieldcal.names import SENSORS

CONTRACT = """
[defaults]
method = "serial"
profile = "full"
[defaults.parameters]
smoothing_cutoff_hz = 8.0
smoothing_ends = "odd"
ellipsoid = "robust"
attitude = "quest"
equations = "all"
use_vps = false
[vehicles."morpheus-1"]
imu_id = "MAG3-0042"
world = "ned"
body = "frd"
gravity_sign = "gravity"
gravity_mps2 = 9.80665
field = { north_east_down = [1.0, 0.0, 0.0], unit = "norm" }
rotation_body_from_sensor = [[1,0,0],[0,1,0],[0,0,1]]
lever_arm_m = [0.05, 0.02, -0.03]
polarity = { magnetometer = [1,1,-1], accelerometer = [1,1,-1], gyroscope = [-1,1,1] }
units = { magnetometer = "counts", accelerometer = "counts", gyroscope = "counts" }
nominal_scale = { magnetometer = 1.5e-4, accelerometer = [4e-3, 4e-3, 5e-3], gyroscope = 3e-4 }
reference_reading = { gyroscope = [33000, 32400, 32900] }
[vehicles."morpheus-1".csv]
time_unit = "s"
rate_hz = 100.0
separator = ";"
decimal = ","
vps = { t = "t_s", quaternion_xyzw = ["qx","qy","qz","qw"], position = ["px","py","pz"] }
[vehicles."morpheus-1".csv.imu]
t = "t_s"
gyroscope = ["gx","gy","gz"]
accelerometer = ["ax","ay","az"]
magnetometer = ["mx","my","mz"]
temperature = "temp"
current = "amps"
throttle = "throttle"
[vehicles."morpheus-1".mcap]
imu = "/imu/data_raw"
magnetometer = "/imu/mag"
vps = "/vps/pose"
power = "/battery"
time = "log"
imu_fields = { gyroscope = "gyro", accelerometer = ["a.x", "a.y", "a.z"], magnetometer = "mag", temperature = "t" }
[archive]
logs = [{ glob = "2026/*/flight_*.csv", vehicle = "morpheus-1", session = "spring" }]
[alerts]
expires_days = 45
"""

FLEET = """
[vehicles."broad-imu-1"]
imu_id = "broad-imu"
world = "enu"
body = "flu"
gravity_sign = "specific_force"
gravity_mps2 = 9.813
field = { north_east_down = [15.6e-6, 0.0, 41.4e-6], unit = "T" }

[vehicles."counts"]
polarity = { gyroscope = [-1, 1, 1], accelerometer = [1, 1, -1], magnetometer = [1, 1, -1] }
units = { gyroscope = "counts", accelerometer = "counts", magnetometer = "counts" }

[vehicles."samples"]
units = { gyroscope = "counts", accelerometer = "counts" }
[vehicles."samples".csv]
rate_hz = 102.4
imu = { t = "sample", gyroscope = ["gx", "gy", "gz"], accelerometer = ["ax", "ay", "az"] }

[vehicles."no-time"]
units = { accelerometer = "g", magnetometer = "G" }
[vehicles."no-time".csv]
rate_hz = 100.0
imu = { accelerometer = ["ax", "ay", "az"], magnetometer = ["mx", "my", "mz"] }

[vehicles."headers"]
gravity_sign = "specific_force"
body = "flu"
[vehicles."headers".csv.imu]
t = "Time (s)"
gyroscope = ["Gyroscope X (deg/s)", "Gyroscope Y (deg/s)", "Gyroscope Z (deg/s)"]
accelerometer = ["Accelerometer X (g)", "Accelerometer Y (g)", "Accelerometer Z (g)"]
magnetometer = ["Magnetometer X (uT)", "Magnetometer Y (uT)", "Magnetometer Z (uT)"]
"""


def test_every_key_of_the_contract_is_understood() -> None:
    configuration = parse(CONTRACT, None)
    vehicle = configuration.vehicle("morpheus-1")
    assert vehicle.imu_id == "MAG3-0042"
    assert (vehicle.world, vehicle.body, vehicle.gravity_sign) == ("ned", "frd", "gravity")
    assert vehicle.field == LocalField(unit="norm", north_east_down=(1.0, 0.0, 0.0))
    assert vehicle.lever_arm_m == (0.05, 0.02, -0.03)
    assert vehicle.polarity["gyroscope"] == (-1, 1, 1)
    assert vehicle.nominal_scale["magnetometer"] == (1.5e-4, 1.5e-4, 1.5e-4)
    assert vehicle.nominal_scale["accelerometer"] == (4e-3, 4e-3, 5e-3)
    assert vehicle.reference_reading == {"gyroscope": (33000.0, 32400.0, 32900.0)}
    assert vehicle.csv.imu["gyroscope"] == ("gx", "gy", "gz")
    assert (vehicle.csv.imu["current"], vehicle.mcap.power) == ("amps", "/battery")
    assert vehicle.csv.vps["quaternion_xyzw"] == ("qx", "qy", "qz", "qw")
    assert (vehicle.csv.separator, vehicle.csv.decimal, vehicle.csv.rate_hz) == (";", ",", 100.0)
    assert (vehicle.mcap.imu, vehicle.mcap.time) == ("/imu/data_raw", "log")
    assert vehicle.mcap.imu_fields is not None
    assert vehicle.mcap.imu_fields["accelerometer"] == ("a.x", "a.y", "a.z")
    assert configuration.logs[0].vehicle == "morpheus-1"
    assert configuration.alerts == Alerts(expires_days=45.0, idle_days=30.0)


def test_a_fleet_of_different_vehicles_loads(tmp_path: Path) -> None:
    path = tmp_path / "fieldcal.toml"
    path.write_text(FLEET, encoding="utf-8")
    configuration = load(path)
    assert configuration.path == path
    assert configuration.vehicle("broad-imu-1").field == LocalField(unit="T", north_east_down=(15.6e-6, 0.0, 41.4e-6))
    assert configuration.vehicle("counts").units["magnetometer"] == "counts"
    assert configuration.vehicle("samples").csv.rate_hz == 102.4
    assert "t" not in configuration.vehicle("no-time").csv.imu
    assert configuration.vehicle("headers").csv.imu["t"] == "Time (s)"


def test_without_a_file_the_log_decides() -> None:
    vehicle = load(None).vehicle("anything ../ goes")
    assert (vehicle.vehicle_id, vehicle.imu_id) == ("anything ../ goes", "anything ../ goes")
    assert (vehicle.world, vehicle.body, vehicle.gravity_sign, vehicle.field, vehicle.lever_arm_m) == (None,) * 5
    assert vehicle.gravity_mps2 == 9.80665
    assert vehicle.polarity == dict.fromkeys(("magnetometer", "accelerometer", "gyroscope"), (1, 1, 1))
    assert vehicle.units == {}
    assert vehicle.parameters == Parameters()


def test_vehicles_override_defaults_key_by_key() -> None:
    configuration = parse(
        """
        [defaults]
        profile = "onboard"
        units = { gyroscope = "deg/s", accelerometer = "g" }
        field = { latitude_deg = 52.5, longitude_deg = 13.4 }
        csv = { imu = { t = "time", temperature = "T" } }
        [defaults.parameters]
        smoothing_cutoff_hz = 5
        attitude = "triad"
        [vehicles.a]
        units = { accelerometer = "counts" }
        field = { north_east_down = [1, 0, 1], unit = "G" }
        csv = { imu = { t = "stamp" }, rate_hz = 50 }
        parameters = { attitude = "svd" }
        [vehicles.b]
        profile = "paper"
        """,
        None,
    )
    a, b, other = (configuration.vehicle(name) for name in ("a", "b", "other"))
    assert a.units == {"gyroscope": "deg/s", "accelerometer": "counts"}
    assert a.field == LocalField(unit="G", north_east_down=(1.0, 0.0, 1.0))
    assert a.csv.imu == {"t": "stamp", "temperature": "T"}
    assert a.parameters.attitude == "svd"
    assert a.parameters.smoothing_cutoff_hz == 5.0
    assert a.parameters.ellipsoid == "two_step"
    assert (b.profile, b.parameters.ellipsoid, b.parameters.attitude) == ("paper", "li", "triad")
    assert other.field == LocalField(unit="uT", latitude_deg=52.5, longitude_deg=13.4)
    assert other.parameters.attitude == "triad"


def test_settings_are_plain_json_and_leave_names_out() -> None:
    configuration = parse(CONTRACT, None)
    settings = configuration.vehicle("morpheus-1").settings()
    assert json.loads(json.dumps(settings)) == settings
    assert not {"vehicle_id", "imu_id", "profile"} & settings.keys()
    assert settings["field"]["unit"] == "norm"
    other = parse(CONTRACT.replace("MAG3-0042", "MAG3-0043"), None).vehicle("morpheus-1").settings()
    assert other == settings
    assert parse(CONTRACT.replace("8.0", "9.0"), None).vehicle("morpheus-1").settings() != settings


@pytest.mark.parametrize(
    ("document", "reason_code", "sentence"),
    [
        ("[default]\n", "unknown_key", 'did you mean "defaults"'),
        (
            "[vehicles.a]\nprofil = 'full'",
            "unknown_key",
            'vehicles.a: there is no key "profil"; did you mean "profile"',
        ),
        ("[vehicles.a]\nzzzzzz = 1", "unknown_key", "did you mean .* Known here: imu_id"),
        ("[vehicles.a.parameters]\nsmothing_cutoff_hz = 1", "unknown_key", 'did you mean "smoothing_cutoff_hz"'),
        ("[vehicles.a.csv.imu]\ngyro = ['x','y','z']", "unknown_key", 'did you mean "gyroscope"'),
        ("[vehicles.a]\nunits = { compass = 'T' }", "unknown_key", "did you mean"),
        ("[vehicles.a.method]\ngyroscope = 'magic'", "wrong_value", '"magic" is not one of auto, serial, joint'),
        ("[vehicles.a.method]\ngyro = 'joint'", "unknown_key", 'did you mean "gyroscope"?'),
        ("[vehicles.a]\nmethod = 'magic'", "wrong_value", '"magic" is not one of auto, serial, joint'),
        ("[vehicles.a]\nworld = 'NED'", "wrong_value", 'not one of ned, enu; did you mean "ned"'),
        ("[vehicles.a]\nimu_id = 7", "wrong_type", "imu_id: a text is needed here, or a list of tables .*, not 7"),
        ("[vehicles.a]\nimu_id = []", "wrong_type", "a list of tables with id and from, not \\[\\]"),
        ('[vehicles.a]\nimu_id = [{ id = "A", form = 2026-05-04 }]', "unknown_key", 'imu_id.0: .*did you mean "from"'),
        ('[vehicles.a]\nimu_id = [{ id = "A", from = "May" }]', "wrong_type", "imu_id.0.from: a date such as"),
        ("[vehicles.a]\nimu_id = [{ from = 2026-05-04 }]", "wrong_type", "imu_id.0.id: a text is needed"),
        ("[vehicles.a]\nunits = { gyroscope = 'T' }", "wrong_value", "counts, rad/s, deg/s"),
        ("[vehicles.a]\ngravity_mps2 = 981", "wrong_value", "from 9.7 to 9.9"),
        ("[vehicles.a]\ngravity_mps2 = nan", "wrong_value", "from 9.7 to 9.9"),
        ("[vehicles.a]\nlever_arm_m = [1, 2]", "wrong_type", "a list of 3 numbers"),
        ("[vehicles.a]\nlever_arm_m = [1, 2, inf]", "wrong_value", "must be finite"),
        ("[vehicles.a]\nlever_arm_m = [1, 2, true]", "wrong_type", "a number is needed here, not true"),
        ("[vehicles.a]\npolarity = { gyroscope = [1, 1, 2] }", "wrong_value", "must be 1 or -1"),
        ("[vehicles.a]\nnominal_scale = { gyroscope = 0 }", "wrong_value", "above zero"),
        ("[vehicles.a]\nrotation_body_from_sensor = [[1,0,0],[0,1,0],[0,0.1,1]]", "wrong_value", "not a rotation"),
        ("[vehicles.a]\nrotation_body_from_sensor = [[1,0,0],[0,1,0],[0,0,-1]]", "wrong_value", "reflection"),
        ("[vehicles.a]\nfield = { north_east_down = [1,0,0] }", "wrong_value", "needs its unit"),
        ("[vehicles.a]\nfield = { north_east_down = [0,0,0], unit = 'T' }", "wrong_value", "cannot be zero"),
        ("[vehicles.a]\nfield = { latitude_deg = 52.0 }", "wrong_value", "longitude_deg is missing"),
        ("[vehicles.a]\nfield = { latitude_deg = 95.0, longitude_deg = 0 }", "wrong_value", "from -90 to 90"),
        (
            "[vehicles.a]\nfield = { north_east_down = [1,0,0], unit = 'T', latitude_deg = 1 }",
            "wrong_value",
            "not both",
        ),
        ("[vehicles.a.csv]\nrate_hz = -1", "wrong_value", "above zero"),
        ("[vehicles.a.csv]\nseparator = ', '", "wrong_value", "single character"),
        ("[vehicles.a.csv]\nimu = { gyroscope = ['x','x','z'] }", "wrong_value", "one thing twice"),
        ("[vehicles.a.parameters]\nuse_vps = 1", "wrong_type", "true or false"),
        ("[vehicles.a.parameters]\nsmoothing_cutoff_hz = 'fast'", "wrong_type", 'a number is needed here, not "fast"'),
        ("[vehicles.a.parameters]\nsmoothing_cutoff_hz = 501.0", "wrong_value", "from 0 to 500"),
        ("[vehicles.a.parameters]\nattitude = 'kalman'", "wrong_value", "quest, davenport"),
        ("[vehicles]\na = 3", "wrong_type", "a table is needed here, not 3"),
        ("[archive]\nlogs = [{ glob = '../x/*.csv' }]", "wrong_value", "leaves the archive"),
        ("[archive]\nlogs = [{ vehicle = 'a' }]", "wrong_value", "glob is missing"),
        ("[archive]\nlogs = 3", "wrong_type", "a list of tables"),
        ("[alerts]\nidle_days = 0", "wrong_value", "above zero"),
        ("[alerts]\nexpires_days = '90'", "wrong_type", "a number is needed here"),
        ("[alerts]\nexpire_days = 90", "unknown_key", "expires_days"),
        ("[vehicles.a\n", "config_syntax", "is not TOML"),
    ],
)
def test_mistakes_are_named_with_file_key_and_what_is_allowed(document: str, reason_code: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError, match=sentence) as caught:
        parse(document, Path("night.toml"))
    assert caught.value.reason_code == reason_code
    assert caught.value.sentence.startswith("night.toml: ")


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"absent\.toml: cannot be read") as caught:
        load(tmp_path / "absent.toml")
    assert caught.value.reason_code == "config_not_readable"
    latin = tmp_path / "latin.toml"
    latin.write_bytes(b'[vehicles.a]\nimu_id = "\xe4"')
    with pytest.raises(ConfigurationError, match="not UTF-8"):
        load(latin)
    marked = tmp_path / "marked.toml"
    marked.write_bytes(b"\xef\xbb\xbf[vehicles.a]\nimu_id = 'x'")
    assert load(marked).vehicle("a").imu_id == "x"


def test_method_is_one_name_or_one_a_sensor() -> None:
    loaded = parse(
        """
        [defaults]
        method = "joint"
        [vehicles.a.method]
        magnetometer = "serial"
        [vehicles.b]
        method = "serial"
        """,
        None,
    )
    assert loaded.vehicle("c").method == dict.fromkeys(SENSORS, "joint")
    assert loaded.vehicle("a").method == {"magnetometer": "serial", "accelerometer": "joint", "gyroscope": "joint"}
    assert loaded.vehicle("b").method == dict.fromkeys(SENSORS, "serial")
