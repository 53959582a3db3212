"""``piga completion``: the script that completes commands and options with the Tab key."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from piga.cli.common import say

WHERE = {
    "bash": "piga completion bash >> ~/.bashrc",
    "zsh": "piga completion zsh > ~/.zfunc/_piga, with 'fpath+=~/.zfunc; autoload -Uz compinit; compinit' in ~/.zshrc",
    "fish": "piga completion fish > ~/.config/fish/completions/piga.fish",
}
"""How to install the script of each shell."""


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish"],
        typer.Argument(metavar="SHELL", help="bash, zsh or fish.", show_default=False),
    ],
) -> None:
    """Print the script for completion with Tab.

    Install it with: piga completion bash >> ~/.bashrc; zsh: into a file _piga of your fpath; fish:
    piga completion fish > ~/.config/fish/completions/piga.fish. Then open a new shell.
    """
    from typer._completion_shared import get_completion_script

    say(f"# {WHERE[shell]}" if shell != "zsh" else "#compdef piga")
    script = get_completion_script(prog_name="piga", complete_var="_PIGA_COMPLETE", shell=shell)
    say(script.removeprefix("#compdef piga").strip())
