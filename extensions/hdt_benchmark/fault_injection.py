"""Injection of a known fault into recorded nominal legs, with the truth.

Weather, sensors, load and controller are those of the record; only the fault is made (Pujana et al. 2023). The physics
are the declared models', with whatever design the caller holds for the fleet's.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, clean_conductance_w_k, measured_conductance_w_k, outlets_k
from hdt_core.physics.installed_exchanger import RAM_DUCT
from hdt_core.physics.model import PhysicsModel
from hdt_core.simulate.packs import FULL_OPEN, bisect_door
from hdt_core.simulate.recorder import FOOT, LB_PER_MIN, PSI, SENSORS, with_sensor_fault
from hdt_core.simulate.signals import ZERO_C

Array = NDArray[np.float64]

STEPS = 24
"""Of the bisection for the door: a ten-millionth of its travel."""
TEXTBOOK_EXCHANGER = HEAT_EXCHANGER.calibrated({"hx_ua_reference_w_k": 1500.0, "hx_wall_share": 0.05})
TEXTBOOK_DUCT = RAM_DUCT.calibrated(
    {
        "ram_area_closed_m2": 0.004,
        "ram_area_open_m2": 0.05,
        "ram_door_high": 0.5,
        "ram_core_area_m2": 0.04,
        "ram_exit_area_m2": 0.06,
        "ram_recovery": 0.9,
    }
)
"""What is flown where no design is given; not the declared values, for the twin's own prior would flatter it."""
_FILMS = ("hx_exponent_hot", "hx_exponent_cold", "hx_hot_share", "hx_wall_share")


@dataclass(frozen=True, slots=True)
class Fouling:
    """Loss of this share of the exchanger's conductance, linear over some flights or at once (a clog).

    `masked`: the controller opens the door as far as it must to hold the outlet it held. Otherwise the door stays where
    it was recorded, and the outlet shows all of the loss.
    """

    loss: float
    over_flights: int = 0
    masked: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.loss < 1.0 or self.over_flights < 0:
            raise ValueError(f"a loss lies in 0..1 and takes 0 flights or more, not {self.loss}, {self.over_flights}")


@dataclass(frozen=True, slots=True)
class DoorLimit:
    """Ram air door limited to the opening `reach`. [-], 0 shut, 1 full open"""

    reach: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.reach <= 1.0:
            raise ValueError(f"a door's reach lies in 0..1, not {self.reach}")


@dataclass(frozen=True, slots=True)
class SensorFault:
    """Sensor fault of a column: offset or drift by `size` in its unit (after 25 flights), frozen, or 70 % missing."""

    column: str
    kind: Literal["drift", "step", "stuck", "dropout"]
    size: float = 0.0

    def __post_init__(self) -> None:
        if self.column not in SENSORS:
            raise ValueError(f"{self.column} is no recorded signal; there are {', '.join(SENSORS)}")


Fault = Fouling | DoorLimit | SensorFault


@dataclass(frozen=True, slots=True)
class Injection:
    """Rows with the fault, and the truth of each flight of the pack.

    `truth`: one row a flight in order, `flight_id`, `pack`, `since` (flights since the first faulty one, null before),
    `hx_fouling` (added to what the unit had), `ram_door_reach`, `sensor_fault` (a column, empty where none).
    """

    rows: pl.DataFrame
    truth: pl.DataFrame


def inject(
    rows: pl.DataFrame,
    fault: Fault,
    *,
    pack: int,
    first_flight: str,
    seed: int = 0,
    duct: PhysicsModel = TEXTBOOK_DUCT,
    exchanger: PhysicsModel = TEXTBOOK_EXCHANGER,
) -> Injection:
    """Inject a fault into the flights of one pack from `first_flight` on.

    Parameters
    ----------
    rows : DataFrame
        Of one aircraft, in the recorder's columns and units (docs/raw-data.md): snapshots or a 1 Hz log.
    pack : int
    first_flight : str
        Its `flight_id`.
    seed : int
        Decides which values a dropout takes.
    duct, exchanger : PhysicsModel, optional
        What ram flow and conductance follow: `RAM_DUCT` and `HEAT_EXCHANGER`, calibrated where the design is known;
        a textbook's values where it is not.

    Returns
    -------
    Injection
        All rows, those of the pack changed. A row without the values that the physics need stays as it is, and new
        values are not rounded to the recorder's last digit.

    Raises
    ------
    ValueError
        The pack has no such flight, or its rows lack a column that the fault changes.

    Notes
    -----
    The conductance of each row is measured from the row itself, scaled to the flows at the new door position and
    reduced by the loss. So a row keeps its own noise, and the unit the wear it had. Steady state: the core's lag, a
    matter of seconds, is left out of a 1 Hz log.
    """
    flights = rows.filter(pl.col("pack") == pack).group_by("flight_id").agg(pl.col("report_time").min())
    order = flights.sort("report_time", "flight_id")["flight_id"].to_list()
    if first_flight not in order:
        raise ValueError(f"pack {pack} has no flight {first_flight}")
    _check_columns(rows, fault)
    number = {flight: k - order.index(first_flight) for k, flight in enumerate(order)}
    turn = pl.col("flight_id").replace_strict(number, default=-1, return_dtype=pl.Int64)
    since = rows.select(pl.when(pl.col("pack") == pack).then(turn).otherwise(-1)).to_series().to_numpy()
    if isinstance(fault, SensorFault):
        column = rows[fault.column].cast(pl.Float64).to_numpy()
        rng = np.random.default_rng(seed)
        broken = with_sensor_fault(rng, column, flight=since, faulty=since >= 0, kind=fault.kind, size=fault.size)
        new_values = {fault.column: broken}
    else:
        new_values = _physics_values(rows, fault, since, duct, exchanger)
    faulty_rows = rows.with_columns(pl.Series(name, values).fill_nan(None) for name, values in new_values.items())
    return Injection(faulty_rows, _truth(order, number, fault, pack))


def _check_columns(rows: pl.DataFrame, fault: Fault) -> None:
    air = ("altitude_ft", "mach", "tat_degc", "pt_psia")
    required = (*air, "hx_in_degc", "hx_out_degc", "ram_door_pct", "pack_flow_lbpm")
    names = (fault.column,) if isinstance(fault, SensorFault) else required
    missing = [name for name in names if name not in rows.columns]
    if missing:
        raise ValueError(f"the rows lack {', '.join(missing)}")


def _loss(fault: Fault, since: NDArray[np.int_]) -> Array:
    """Compute the share of conductance lost on each flight."""
    if not isinstance(fault, Fouling):
        return np.zeros(since.size)
    ramp = np.minimum((since + 1.0) / max(fault.over_flights, 1), 1.0)
    return np.where(since >= 0, fault.loss * ramp, 0.0)


def _physics_values(
    rows: pl.DataFrame, fault: Fouling | DoorLimit, since: NDArray[np.int_], duct: PhysicsModel, exchanger: PhysicsModel
) -> dict[str, Array]:
    """Compute door, outlet and ram outlet by the physics where the fault acts, else as recorded."""
    signals = {n: rows[n].cast(pl.Float64).to_numpy() for n in SENSORS if n in rows.columns}
    flow = signals["pack_flow_lbpm"] * LB_PER_MIN
    hot_k = signals["hx_in_degc"] + ZERO_C
    out_k = signals["hx_out_degc"] + ZERO_C
    cold_k = signals["tat_degc"] + ZERO_C
    door = 0.01 * signals["ram_door_pct"]
    loss = _loss(fault, since)
    air = {"total_pressure_pa": PSI * signals["pt_psia"], "tat_k": cold_k, "altitude_m": FOOT * signals["altitude_ft"]}
    films = {name: np.asarray(exchanger.nominal[name]) for name in (*_FILMS, "hx_ua_reference_w_k")}

    def ram(at: Array) -> Array:
        return duct.predict({}, air | {"mach": signals["mach"], "ram_door_open": np.clip(at, 0.0, 1.0)})[
            "ram_flow_kg_s"
        ]

    def outlets(at: Array, share: Array) -> tuple[Array, Array]:
        scale = clean_conductance_w_k(flow, ram(at), **films) / clean_conductance_w_k(flow, ram(door), **films)
        return outlets_k(flow, ram(at), hot_k, cold_k, (1.0 - share) * scale * ua_w_k)

    with np.errstate(all="ignore"):
        ua_w_k = measured_conductance_w_k(flow, ram(door), hot_k, out_k, cold_k)
        if isinstance(fault, DoorLimit):
            new_door = np.minimum(door, fault.reach)
        elif fault.masked:
            new_door = bisect_door(lambda at: outlets(at, loss)[0] > out_k, door, np.maximum(door, FULL_OPEN), STEPS)
        else:
            new_door = door
        old_outlets = outlets(door, 0.0 * loss)
        new_outlets = outlets(new_door, loss)
    is_faulty = (since >= 0) & np.isfinite(ua_w_k) & np.isfinite(new_outlets[0])
    changes = {"ram_door_pct": 100.0 * (new_door - door), "hx_out_degc": new_outlets[0] - out_k}
    if "ram_out_degc" in signals:
        changes["ram_out_degc"] = new_outlets[1] - old_outlets[1]
    return {name: signals[name] + np.where(is_faulty, change, 0.0) for name, change in changes.items()}


def _truth(order: list[str], number: dict[str, int], fault: Fault, pack: int) -> pl.DataFrame:
    since = np.array([number[flight] for flight in order])
    reach = fault.reach if isinstance(fault, DoorLimit) else FULL_OPEN
    sensor = fault.column if isinstance(fault, SensorFault) else ""
    faulty = pl.col("since") >= 0
    return pl.DataFrame({"flight_id": order, "since": since, "hx_fouling": _loss(fault, since)}).select(
        "flight_id",
        pl.lit(pack, pl.Int32).alias("pack"),
        pl.when(faulty).then("since").alias("since"),
        "hx_fouling",
        pl.when(faulty).then(reach).otherwise(FULL_OPEN).alias("ram_door_reach"),
        pl.when(faulty).then(pl.lit(sensor)).otherwise(pl.lit("")).alias("sensor_fault"),
    )
