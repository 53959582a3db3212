"""Parameters of the servo twin: named, with symbol, unit, plausible range and source.

The presets are examples for study. They describe no real instrument.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from piga._kernels.servo import ServoConstants
from piga.errors import ArgumentError
from piga.units import G0, to_si

_THEORY = "theory page, the twin"
_CHOICE = "example value"


def _entry(
    default: float, symbol: str, unit: str, low: float, high: float, meaning: str, source: str = _CHOICE
) -> Any:
    metadata = {"symbol": symbol, "unit": unit, "range": (low, high), "meaning": meaning, "source": source}
    return field(default=default, metadata=metadata)


_INF = math.inf


@dataclass(frozen=True)
class TwinParameters:
    """Rotor, float, gimbal, pick-off, servo and torque motor of a PIGA, SI units.

    Each field's ``metadata`` holds symbol, unit, plausible range, meaning and source. The inertias are
    those about the pivot, pendulous mass included; rotor spin is in ``angular_momentum`` only.
    Construction refuses values outside the plausible range.
    """

    angular_momentum: float = _entry(0.1, "H", "kg m^2/s", 1e-3, 10, "rotor angular momentum", _THEORY)
    pendulosity: float = _entry(0.1 * 0.8884 / G0, "ml", "kg m", 1e-5, 1, "pendulosity of the float", _THEORY)
    outer_inertia: float = _entry(5e-5, "J_o", "kg m^2", 1e-7, 1, "outer gimbal inertia", _THEORY)
    float_inertia_x: float = _entry(
        5e-5, "A", "kg m^2", 1e-7, 1, "float about its x axis (input side)", _THEORY
    )
    float_inertia_y: float = _entry(5e-5, "B", "kg m^2", 1e-7, 1, "float about the inner-gimbal axis", _THEORY)
    float_inertia_z: float = _entry(
        5e-5, "C", "kg m^2", 1e-7, 1, "float about the rotor axis, without the rotor's spin"
    )
    product_of_inertia: float = _entry(
        0.0, "D", "kg m^2", -1e-2, 1e-2, "integral of x z dm over the float: the origin of k2", _THEORY
    )
    damping: float = _entry(0.05, "c", "Nm s/rad", 0, 100, "damping of the float about the inner axis", _THEORY)
    restoring: float = _entry(0.0, "k_r", "Nm/rad", 0, 100, "elastic restoring torque about the inner axis")
    restoring_zero: float = _entry(
        0.0, "beta_r", "rad", -0.1, 0.1, "tilt at which the restoring torque vanishes"
    )
    viscous_friction: float = _entry(0.0, "c_x", "Nm s/rad", 0, 100, "viscous friction on the outer axis")
    coulomb_friction: float = _entry(0.0, "M_c", "Nm", 0, 10, "Coulomb friction on the outer axis")
    coulomb_rate: float = _entry(
        1e-3, "w_c", "rad/s", 1e-6, 1, "rate over which Coulomb friction changes sign: -M_c tanh(w/w_c)"
    )
    proportional_gain: float = _entry(30.0, "k_p", "Nm/rad", 0, 1e6, "servo gain on the pick-off", _THEORY)
    integral_gain: float = _entry(600.0, "k_i", "Nm/(rad s)", 0, 1e8, "servo gain on its integral", _THEORY)
    rate_gain: float = _entry(0.0, "k_d", "Nm s/rad", 0, 1e4, "servo gain on the tilt rate", _THEORY)
    pick_off_null: float = _entry(
        0.0, "beta_null", "rad", -0.1, 0.1, "tilt that the pick-off calls null: becomes beta", _THEORY
    )
    pick_off_range: float = _entry(_INF, "e_max", "rad", 1e-6, _INF, "largest pick-off signal")
    torque_limit: float = _entry(_INF, "M_max", "Nm", 1e-9, _INF, "saturation of the torque motor")
    stop_angle: float = _entry(0.05, "beta_stop", "rad", 1e-4, 0.5, "tilt at which the float meets its stops")
    stop_stiffness: float = _entry(200.0, "k_stop", "Nm/rad", 0, 1e6, "stiffness of the stops")
    stop_damping: float = _entry(
        0.1, "c_stop", "s/rad", 0, 100, "relative rise of the stops' stiffness per tilt rate going in"
    )
    outer_torque: float = _entry(0.0, "M_x", "Nm", -10, 10, "constant torque on the outer axis")
    inner_torque: float = _entry(
        0.0, "M_y", "Nm", -10, 10, "constant torque on the inner axis: a bias of -M_y/ml"
    )
    pick_off_noise: float = _entry(0.0, "S_e", "rad sqrt(s)", 0, 1e-2, "one-sided pick-off noise density")
    torque_noise: float = _entry(0.0, "S_M", "Nm sqrt(s)", 0, 1, "one-sided noise density of the outer torque")
    hunting: float = _entry(0.0, "h_w", "1", 0, 0.1, "relative amplitude of wheel-speed hunting")
    hunting_frequency: float = _entry(1.0, "f_w", "Hz", 1e-4, 100, "frequency of wheel-speed hunting")
    hunting_phase: float = _entry(0.0, "phi_w", "rad", -7, 7, "phase of wheel-speed hunting at t = 0")
    spin_start: float = _entry(1.0, "s_0", "1", 0.05, 1.0, "wheel speed at t = 0 over its final value")
    spin_time: float = _entry(30.0, "t_s", "s", 1e-2, 1e5, "time constant of spin-up")
    alpha0: float = _entry(0.0, "alpha_0", "rad", -1e6, 1e6, "outer-gimbal angle at t = 0")

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, (low, high) = getattr(self, entry.name), entry.metadata["range"]
            if not low <= value <= high:
                raise ArgumentError(
                    f"twin parameter {entry.name} ({entry.metadata['symbol']}) = {value:g} "
                    f"{entry.metadata['unit']} is outside its plausible range {low:g} to {high:g}",
                    remedy="check the value and its unit",
                )
        if self.float_inertia_x * self.float_inertia_z <= self.product_of_inertia**2:
            raise ArgumentError(
                "twin parameter product_of_inertia: D^2 must be smaller than A C",
                remedy="use a smaller product of inertia, or larger moments A and C",
            )

    @property
    def K(self) -> float:
        """Scale factor ``ml/H`` [(rad/s)/(m/s^2)]."""
        return self.pendulosity / self.angular_momentum

    @property
    def J_x(self) -> float:
        """Inertia about the outer axis at zero tilt, ``J_o + A`` [kg m^2]."""
        return self.outer_inertia + self.float_inertia_x

    @property
    def nutation(self) -> float:
        """Undamped nutation ``H/sqrt(J_x B)`` [rad/s]."""
        return self.angular_momentum / math.sqrt(self.J_x * self.float_inertia_y)

    def constants(self) -> ServoConstants:
        """The numbers that the kernel takes, by their symbols."""
        values = {entry.metadata["symbol"]: getattr(self, entry.name) for entry in fields(self)}
        return ServoConstants(**{symbol: values[symbol] for symbol in ServoConstants._fields})

    def with_scale_factor(self, K: float) -> TwinParameters:
        """The design with its pendulosity changed to give scale factor ``K``."""
        return replace(self, pendulosity=K * self.angular_momentum)

    def stiffened(self, factor: float) -> TwinParameters:
        """The design with all servo gains multiplied by ``factor``."""
        return replace(
            self,
            proportional_gain=factor * self.proportional_gain,
            integral_gain=factor * self.integral_gain,
            rate_gain=factor * self.rate_gain,
        )


PRESETS: Mapping[str, TwinParameters] = {
    "example": TwinParameters(),
    "example-floated": TwinParameters(
        angular_momentum=0.2,
        pendulosity=0.2 * 0.6 / G0,
        outer_inertia=4e-4,
        float_inertia_x=1.2e-4,
        float_inertia_y=1.0e-4,
        float_inertia_z=1.1e-4,
        damping=0.3,
        restoring=1e-3,
        viscous_friction=1e-3,
        proportional_gain=60.0,
        integral_gain=1500.0,
        rate_gain=0.05,
        pick_off_range=0.01,
        torque_limit=0.5,
    ),
    "example-stiff": TwinParameters(proportional_gain=100.0, integral_gain=6000.0, damping=0.2, rate_gain=0.1),
}
"""Example designs by name; ``example`` is the stable example of the theory page."""


def twin_parameters(values: Mapping[str, str | float], *, where: str = "[twin]") -> TwinParameters:
    """Parameters from text or numbers of a scenario. They replace those of ``preset`` (default ``example``).

    Raises
    ------
    ArgumentError, UnitError
        If a name is unknown, a unit does not fit or a value is implausible; the message names the key.
    """
    chosen = dict(values)
    preset = str(chosen.pop("preset", "example"))
    if preset not in PRESETS:
        raise ArgumentError(f"{where} preset: '{preset}' is unknown", remedy=f"choose {', '.join(PRESETS)}")
    units = {entry.name: str(entry.metadata["unit"]) for entry in fields(TwinParameters)}
    unknown = sorted(set(chosen) - set(units))
    if unknown:
        raise ArgumentError(
            f"{where}: unknown key '{unknown[0]}'", remedy=f"known keys: preset, {', '.join(units)}"
        )
    numbers = {name: to_si(value, units[name], what=f"{where} {name}") for name, value in chosen.items()}
    try:
        return replace(PRESETS[preset], **numbers)
    except ArgumentError as error:
        raise ArgumentError(f"{where}: {error.message}", remedy=error.remedy) from None
