r"""piga: Precision Inertial Gimballed-instrument Analysis.

Calibrate and compensate pendulous integrating gyro accelerometers (PIGA) and analyse the
gimballed platform that carries them. This page states the conventions; all other docstrings
lean on it.

Frames
------
Base frame ``X0 Y0 Z0``
    right-handed, fixed to the instrument case. ``X0`` is the input axis and outer-gimbal axis.
Outer-gimbal frame ``X1 Y1 Z1``
    ``X1 = X0``, ``Y1 = cos(alpha) Y0 + sin(alpha) Z0``, ``Z1 = -sin(alpha) Y0 + cos(alpha) Z0``.
    ``Y1`` is the inner-gimbal (pendulum) axis.
Rotor axis ``z``
    ``z = sin(beta) X1 + cos(beta) Z1``.

Symbols
-------
SI inside; units exist only at the edges: files, command line, reports.

``alpha`` [rad]
    outer-gimbal angle about ``X0``, positive from ``Y0`` towards ``Z0``; the output; unwrapped.
``psi`` [rad]
    output angle as read, ``alpha = psi + phi``; its zero is arbitrary.
``phi`` [rad]
    phase of the output zero; one per power-up.
``beta`` [rad]
    non-orthogonality of rotor axis and outer-gimbal axis; enters as ``tan_beta``.
``H``, ``ml``, ``K = ml/H``
    rotor angular momentum [kg m^2/s], pendulosity [kg m], scale factor [(rad/s)/(m/s^2)].
``f = (a_x, a_Y, a_Z)`` [m/s^2]
    specific force of the base in base axes. At rest it points up.
``a_t, gamma``
    transverse specific force: ``a_Y = a_t cos(gamma)``, ``a_Z = a_t sin(gamma)``.
``Omega`` [rad/s]
    inertial angular rate of the base in base axes; ``u = K f - Omega``.
``g``
    the unit: exactly 9.80665 m/s^2.

The model
---------
.. math::

   \alpha' = u_x + \tan\beta\,(u_Y \sin\alpha - u_Z \cos\alpha), \qquad u = K f - \Omega

Specific force is smooth between sample times, in :func:`propagate`, :func:`calibrate` and
:func:`compensate` alike. Numbers handed to
the library are SI; text such as ``"0.8884 rad/s/g"`` carries its unit.

Tasks
-----
Each takes about five lines: see docs/reference/api, and the code beside each command.

======================  ==============================================================================
Calibrate a record      ``cal = piga.calibrate(piga.read_run("run.toml"))``; ``cal.summary()``
From arrays or a table  ``piga.Run.from_arrays(...)``, ``piga.Run.from_dataframe(...)``
Compensate              ``piga.compensate(run, cal)``; live: ``piga.Compensator(cal)``
A set of instruments    ``piga.compensate_set(runs, mounted)``
Simulate a test         ``piga.run_scenario(piga.read_scenario("scenario.toml"))``
Plan a test             ``piga.plan_test(piga.read_plan("plan.toml"))``
Set of accelerometers   ``piga.calibrate_set(t, outputs, gravity)``
Noise of a static log   ``piga.analyse_noise(values, t)``
Follow over years       ``piga.find_trend([(name, date, cal), ...])``
Motion and regimes      ``piga.propagate``, ``piga.closed_form``, ``piga.regime``
Keep as evidence        ``piga.open_store("records.sqlite")``
Certificate             ``piga.certificate``
The platform            ``piga.platform``
======================  ==============================================================================

A first look
------------
>>> import piga
>>> inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
>>> piga.regime(inst, a_x=0.0981, a_Y=49.03325, a_Z=0.0)
'locked'
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from piga import upper
from piga._version import __version__ as __version__
from piga.errors import missing_package

if TYPE_CHECKING:
    from piga import calibration as calibration
    from piga import campaign as campaign
    from piga import certificate as certificate
    from piga import compensation as compensation
    from piga import gravity_norm as gravity_norm
    from piga import instrument as instrument
    from piga import ledger as ledger
    from piga import noise as noise
    from piga import planning as planning
    from piga import platform as platform
    from piga import records as records
    from piga import reports as reports
    from piga import stand as stand
    from piga import studies as studies
    from piga import trend as trend
    from piga.calibration import RunSummary as RunSummary
    from piga.calibration import compare_models as compare_models
    from piga.calibration.calibrate import calibrate as calibrate
    from piga.compensation import Compensated as Compensated
    from piga.compensation import CompensatedSet as CompensatedSet
    from piga.compensation import Compensator as Compensator
    from piga.compensation import Limits as Limits
    from piga.compensation import Mounted as Mounted
    from piga.compensation import Phase as Phase
    from piga.compensation import compensate as compensate
    from piga.compensation import compensate_set as compensate_set
    from piga.compensation import identify_phase as identify_phase
    from piga.errors import ArgumentError as ArgumentError
    from piga.errors import CalibrationError as CalibrationError
    from piga.errors import CalibrationWarning as CalibrationWarning
    from piga.errors import CancelledError as CancelledError
    from piga.errors import DataError as DataError
    from piga.errors import IdentifiabilityError as IdentifiabilityError
    from piga.errors import MissingPackageError as MissingPackageError
    from piga.errors import PigaError as PigaError
    from piga.errors import PigaWarning as PigaWarning
    from piga.errors import RunFileError as RunFileError
    from piga.errors import StoreError as StoreError
    from piga.errors import UnitError as UnitError
    from piga.gravity_norm import calibrate_set as calibrate_set
    from piga.instrument import ErrorModel as ErrorModel
    from piga.instrument import Instrument as Instrument
    from piga.instrument import closed_form as closed_form
    from piga.instrument import mean_rate as mean_rate
    from piga.instrument import propagate as propagate
    from piga.instrument import propagate_fleet as propagate_fleet
    from piga.instrument import regime as regime
    from piga.ledger.store import open_store as open_store
    from piga.noise import allan_deviation as allan_deviation
    from piga.noise import analyse_noise as analyse_noise
    from piga.planning import plan_mounting as plan_mounting
    from piga.planning import plan_test as plan_test
    from piga.planning import read_plan as read_plan
    from piga.records import Calibration as Calibration
    from piga.records import Coefficient as Coefficient
    from piga.records import Residuals as Residuals
    from piga.records import Run as Run
    from piga.stand import example_run as example_run
    from piga.stand import read_run as read_run
    from piga.stand import read_scenario as read_scenario
    from piga.stand import run_scenario as run_scenario
    from piga.stand import simulate_test as simulate_test
    from piga.trend import find_trend as find_trend

_NAMES = {
    "calibration": "RunSummary compare_models",
    "calibration.calibrate": "calibrate",
    "campaign": "",
    "certificate": "",
    "compensation": "Compensated CompensatedSet Compensator Limits Mounted Phase compensate compensate_set identify_phase",
    "errors": "ArgumentError CalibrationError CalibrationWarning CancelledError DataError IdentifiabilityError "
    "MissingPackageError PigaError PigaWarning RunFileError StoreError UnitError",
    "gravity_norm": "calibrate_set",
    "instrument": "ErrorModel Instrument closed_form mean_rate propagate propagate_fleet regime",
    "ledger": "",
    "ledger.store": "open_store",
    "noise": "allan_deviation analyse_noise",
    "planning": "plan_mounting plan_test read_plan",
    "platform": "",
    "records": "Calibration Coefficient Residuals Run",
    "reports": "",
    "stand": "example_run read_run read_scenario run_scenario simulate_test",
    "studies": "",
    "trend": "find_trend",
}
"""The rooms, with their public names that are public here too."""
_LAZY = {name: f"piga.{room}" for room, names in _NAMES.items() for name in names.split()}
ROOMS = tuple(room for room in _NAMES if "." not in room and room != "errors")
"""Rooms with further public names; ``piga.platform`` is imported on first use."""
_NEEDS = {
    "scipy": "allan_deviation analyse_noise calibrate calibrate_set compare_models find_trend plan_mounting plan_test read_plan",
    "pyarrow": "example_run read_run read_scenario run_scenario",
}
"""Public names that cannot do without a package beyond the small core."""


def _doors() -> ModuleType:
    """The rooms that show results; imported on first use."""
    from piga import doors

    return doors


upper.HANDED[:] = [_doors]

__all__ = list(_LAZY)


def __getattr__(name: str) -> Any:
    """Import a public name from its room on first use: ``import piga`` itself stays light."""
    if name in _LAZY:
        for package, names in _NEEDS.items():
            if name in names.split() and find_spec(package) is None:
                raise missing_package(package)
        globals()[name] = getattr(import_module(_LAZY[name]), name)
        return globals()[name]
    if name in ROOMS:
        return import_module(f"piga.{name}")
    raise AttributeError(f"module 'piga' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, *ROOMS])
