"""Noise of a static record: Allan, modified and Hadamard deviations, and the levels of its noise.

>>> from piga.noise import analyse_noise
>>> analyse_noise.__name__
'analyse_noise'
"""

from piga.noise.analysis import NoiseAnalysis, analyse_noise, read_static_log
from piga.noise.deviations import AllanDeviation, NoiseLevel, NoiseSpectrum, allan_deviation

__all__ = [
    "AllanDeviation",
    "NoiseAnalysis",
    "NoiseLevel",
    "NoiseSpectrum",
    "allan_deviation",
    "analyse_noise",
    "read_static_log",
]
