"""Describe a log from any program, draft its run file, and find the lines that repair a run file."""

from piga.describe.columns import ColumnGuess
from piga.describe.draft import Question, RunFileDraft, setting
from piga.describe.log import Guess, LogDescription, describe_log
from piga.describe.run_file import Suggestion, draft_run_file, suggestions, try_run_file

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
