"""Every published case, computed by the library, beside the publication's number, and judged.

>>> from piga.studies import reproduce
>>> found = reproduce("mounting")
>>> [case.verdict for case in found.cases]
['pass', 'pass', 'info']
"""

from piga.studies.case import Case, Chapter
from piga.studies.reproduction import CHAPTERS, Reproduction, chosen, reproduce, run_chapters

__all__ = ["CHAPTERS", "Case", "Chapter", "Reproduction", "chosen", "reproduce", "run_chapters"]
