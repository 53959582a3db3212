"""Compute every published case with the library, compare with the published number, and judge the difference.

>>> from piga.studies import reproduce
>>> mounting = reproduce("mounting")
>>> [case.verdict for case in mounting.cases]
['pass', 'pass', 'info']
"""

from piga.studies.case import Case, Chapter
from piga.studies.constant import published_closed_form
from piga.studies.platform import Capstone, capstone, capstone_figure
from piga.studies.recursion import published_recursion
from piga.studies.reproduction import CHAPTERS, Reproduction, reproduce
from piga.studies.revolutions import whole_turns

__all__ = [
    "CHAPTERS",
    "Capstone",
    "Case",
    "Chapter",
    "Reproduction",
    "capstone",
    "capstone_figure",
    "published_closed_form",
    "published_recursion",
    "reproduce",
    "whole_turns",
]
