"""Describe a log from any program, draft its run file, and find the lines that repair a run file."""

from piga.describe.columns import ColumnGuess
from piga.describe.draft import Question, RunFileDraft, setting
from piga.describe.layout import Guess
from piga.describe.log import LogDescription, describe_log
from piga.describe.run_file import draft_run_file, try_run_file
from piga.describe.suggestions import Suggestion, suggestions

__all__ = [
    "ColumnGuess",
    "Guess",
    "LogDescription",
    "Question",
    "RunFileDraft",
    "Suggestion",
    "describe_log",
    "draft_run_file",
    "setting",
    "suggestions",
    "try_run_file",
]
