"""Reference pages made from the code when the site is built: API, command line, files, JSON.

They are written to ``docs/reference/generated``, which git ignores.
"""

from __future__ import annotations

import ast
import json
import pkgutil
import re
import tomllib
from collections.abc import Iterator
from inspect import cleandoc
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import typer
from sphinx.application import Sphinx

import piga
from piga.campaign.campaign_file import CampaignFile
from piga.certificate.certificate_file import CertificateFile
from piga.cli.main import app as command_line
from piga.compensation.sets import TriadFile
from piga.gravity_norm import SetFile
from piga.keys import words_of
from piga.planning.candidates import PlanTable
from piga.platform.scenario import ScenarioFile
from piga.records.run_file import RunFile
from piga.records.terms import TERM_WORDS, UNITS
from piga.stand.scenario import ScenarioTable
from piga.text_files import si_unit, structs_in

EXAMPLES = Path(__file__).parents[1] / "reference" / "examples"
"""Pages of code that use every public name of a room; a test runs them."""
JSON_SCHEMAS = EXAMPLES.parent / "json"
"""Schemas of the documents that commands print (``python -m builders.json_schemas``)."""
JSON_HEAD = """# JSON of the commands

With `--json` a command prints one document and nothing else.
Its members are those below, and no others; `*` is a name from the data.
A change is a line in the changelog.
The files are JSON Schemas in `docs/reference/json` of the sources.
"""
PLAIN = ("units", "frames", "earth", "errors", "gravity_norm")
"""Modules that are rooms of their own."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before any is read."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "reference" / "generated"))
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(folder: Path) -> None:
    """Write all pages; leave a page alone that is right already, so that it is not read again."""
    folder.mkdir(parents=True, exist_ok=True)
    own = {
        "cli": cli_page(),
        "json": json_page(),
        "terms": terms_page(),
        "rooms": rooms_page(),
    }
    pages = api_pages() | own | file_pages()
    for old in folder.glob("*.md"):
        if old.stem not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


# --- API ---------------------------------------------------------------------------------------------


def rooms() -> list[str]:
    """Public rooms of the package: packages with public names, and the plain modules below them."""
    seen = [info.name for info in pkgutil.iter_modules(piga.__path__) if info.ispkg and info.name[0] != "_"]
    return [name for name in seen if hasattr(__import__(f"piga.{name}", fromlist=["x"]), "__all__")] + list(
        PLAIN
    )


def api_pages() -> dict[str, str]:
    """A page for each room, with every public name."""
    pages = {}
    for room in rooms():
        imported = "" if room in PLAIN else "   :imported-members:\n"
        body = f"```{{eval-rst}}\n.. automodule:: piga.{room}\n   :members:\n{imported}```\n"
        shown = ""
        if (EXAMPLES / f"{room}.md").exists():
            lead = (
                "Each block runs as it stands here, one after the other, in a folder with the shipped `examples`; "
                "`run.toml` and `calibration.json` are yours."
            )
            shown = f"## Examples\n\n{lead}\n\n```{{include}} ../examples/{room}.md\n```\n\n## Names\n\n"
        pages[f"api-{room.replace('_', '-')}"] = f"# piga.{room}\n\n{shown}{body}"
    return pages


def rooms_page() -> str:
    """What each room is for, in the order of the contract: the first sentence of the room itself."""
    root = EXAMPLES.parents[2]
    contract = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    floors = [re.findall(r"\w+", floor) for floor in contract["contracts"][0]["layers"]]
    lead = "A room imports only rooms of the floors below it; the contract is in `pyproject.toml`."
    rows = ["| room | floor | what it is for |", "|---|---|---|"]
    for number, floor in enumerate(reversed(floors), 1):
        rows += [f"| `{room}` | {number} | {cell(first_sentence(room)).replace('``', '`')} |" for room in floor]
    rows[2:] = reversed(rows[2:])
    return f"# Rooms\n\n{lead}\n\n" + "\n".join(rows) + "\n"


def first_sentence(room: str) -> str:
    """First line of the module's text."""
    source = Path(piga.__file__).parent / room / "__init__.py"
    source = source if source.exists() else source.parent.with_suffix(".py")
    return (ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or "").partition("\n")[0]


# --- command line ------------------------------------------------------------------------------------


def cli_page() -> str:
    """Every command with its arguments and options, from the command objects themselves."""
    root = typer.main.get_command(command_line)
    codes = "Exit codes: 0 done, 2 wrong use or bad input (one message on stderr), 1 internal error, 130 stopped with Ctrl-C."
    parts = [
        f"# Command line\n\n{codes} `piga --version` prints the version; `--help` stands behind every command.\n"
    ]
    parts += [command_text(name, command) for name, command in walk("piga", root)]
    return "\n".join(parts)


def walk(path: str, command: Any) -> list[tuple[str, Any]]:
    """All commands below ``command`` with their full names."""
    below = getattr(command, "commands", None)
    if below is None:
        return [(path, command)]
    return [one for name, child in below.items() for one in walk(f"{path} {name}", child)]


def command_text(name: str, command: Any) -> str:
    """Heading, help and table of parameters of one command."""
    shown = [parameter for parameter in command.params if parameter.name != "help"]
    arguments = [label_of(parameter) for parameter in shown if parameter.param_type_name == "argument"]
    usage = " ".join([name, "[OPTIONS]", *arguments])
    rows = ["| parameter | meaning | default |", "|---|---|---|"]
    rows += [
        f"| `{label_of(parameter)}` | {cell(getattr(parameter, 'help', '') or '')} | {default_text(parameter.default)} |"
        for parameter in shown
    ]
    return f"## {name}\n\n{command.help}\n\n    {usage}\n\n" + "\n".join(rows) + "\n\n" + in_python(name)


def in_python(name: str) -> str:
    """What does the same in Python: the section of the command, or of its group, in the examples."""
    parts = (EXAMPLES / "commands.md").read_text(encoding="utf-8").split("## ")[1:]
    sections = {title: body.strip() for title, _, body in (part.partition("\n") for part in parts)}
    body = sections.get(name) or sections.get(name.rpartition(" ")[0])
    return "" if body is None else f"In Python:\n\n{body}\n"


def label_of(parameter: Any) -> str:
    """``RUN.toml`` of an argument, ``--out DIR`` of an option."""
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name.upper()) + ("..." if parameter.nargs == -1 else "")
    names = ", ".join(parameter.opts + parameter.secondary_opts)
    return names if parameter.is_flag else " ".join((names, parameter.metavar or "VALUE"))


def default_text(value: Any) -> str:
    """A default as text; nothing where there is none."""
    if value is None or value is False or value == () or callable(value) or type(value).__name__ == "Sentinel":
        return ""
    return f"`{value}`"


def cell(text: str) -> str:
    """Text that does not break a table."""
    return " ".join(text.split()).replace("|", "\\|")


# --- files (TOML) --------------------------------------------------------------------------------------


def file_pages() -> dict[str, str]:
    """A page for each kind of TOML file, from the typed tables that read it."""
    heads = {
        "run-file": (
            "The run file",
            RunFile,
            "One recorded test: `piga check`, `convert`, `calibrate`, `compensate`.",
        ),
        "set-file": (
            "The run file of a set",
            SetFile,
            "Three or more accelerometers in many attitudes: `piga calibrate`.",
        ),
        "scenario-file": ("The scenario file", ScenarioTable, "A synthetic test: `piga simulate`."),
        "plan-file": ("The plan file", PlanTable, "A test to be planned: `piga plan`."),
        "platform-file": ("The platform scenario", ScenarioFile, "A platform run: `piga platform ...`."),
        "campaign-file": ("The campaign file", CampaignFile, "Thousands of tests: `piga campaign`."),
        "certificate-file": (
            "The certificate file",
            CertificateFile,
            "What a certificate says besides the results: `piga certificate issue --data`.",
        ),
        "triad-file": ("The triad file", TriadFile, "Instruments solved together: `piga compensate`."),
    }
    return {name: file_page(*head) for name, head in heads.items()}


def file_page(title: str, kind: type[msgspec.Struct], lead: str) -> str:
    """Tables of keys of all structures that can be reached from ``kind``."""
    note = (
        'A *quantity* is text with a unit (`"0.8884 rad/s/g"`) or a number in SI. An unknown key is an error.'
    )
    parts = [f"# {title}\n\n{lead} {note}\n"]
    seen: list[type[msgspec.Struct]] = []
    collect(kind, seen)
    parts += [struct_text(struct) for struct in seen]
    return "\n".join(parts)


def collect(annotation: Any, seen: list[type[msgspec.Struct]]) -> None:
    """All structures in ``annotation``, each once, outermost first."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        if annotation in seen:
            return
        seen.append(annotation)
        for field in msgspec.structs.fields(annotation):
            collect(field.type, seen)
    for part in get_args(annotation):
        collect(part, seen)


def struct_text(struct: type[msgspec.Struct]) -> str:
    """One structure as a section with its keys."""
    config = struct.__struct_config__
    rows = ["| key | meaning | value | default | example |", "|---|---|---|---|---|"]
    if config.tag is not None:
        rows.append(f'| `{config.tag_field}` | Kind of the table. | `"{config.tag}"` | needed | |')
    for field in msgspec.structs.fields(struct):
        words = words_of(struct, field.encode_name)
        unit = "" if words.unit in ("", "own", "1") else f", {words.unit}"
        rows.append(
            f"| `{field.encode_name}` | {cell(words.sentence)} | {type_text(field.type)}{unit} | {field_default(field)} "
            f"| `{cell(words.example)}` |"
        )
    summary = cleandoc(struct.__doc__ or "").replace("``", "`")
    return f"## {struct.__name__}\n\n{summary}\n\n" + "\n".join(rows) + "\n"


def field_default(field: msgspec.structs.FieldInfo) -> str:
    """Default of a key as it would be written."""
    if field.required:
        return "needed"
    if field.default is msgspec.NODEFAULT or isinstance(field.default, msgspec.Struct):
        return "its defaults" if isinstance(field.default, msgspec.Struct) else ""
    if field.default in (None, (), {}):
        return ""
    if isinstance(field.default, float) and (unit := si_unit(field.type)):
        return f"`{field.default:.6g} {unit}`".replace(" 1`", "`")
    return f"`{cell(json.dumps(field.default, ensure_ascii=False))}`"


def type_text(annotation: Any) -> str:
    """A type in words."""
    if annotation in (str | float | int, str | float):
        return "quantity"
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        plain = si_unit(annotation) and not structs_in(parts[0])
        return "quantity" if plain else type_text(parts[0])
    if origin is Literal:
        return " \\| ".join(f'`"{part}"`' for part in parts)
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(union_texts(parts)))
    if origin is tuple:
        inner = [type_text(part) for part in parts if part is not Ellipsis]
        return f"list of {inner[0]}" if Ellipsis in parts else f"[{', '.join(inner)}]"
    if origin in (list, dict):
        return f"{'list of' if origin is list else 'table of'} {type_text(parts[-1])}"
    if isinstance(annotation, type) and issubclass(annotation, tuple):
        return "list"
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    names = {str: "text", float: "number", int: "whole number", bool: "`true` \\| `false`", Any: "any value"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def union_texts(parts: tuple[Any, ...]) -> list[str]:
    """Members of a union in words; ``None`` is told by the empty default."""
    real = [part for part in parts if part is not type(None)]
    if {str, float} <= set(real):
        rest = [part for part in real if part not in (str, float, int)]
        return ["quantity", *map(type_text, rest)]
    return [type_text(part) for part in real]


# --- terms and methods ---------------------------------------------------------------------------------


def terms_page() -> str:
    """Every term of the error model, from the words that ``piga terms`` prints."""
    rows = [
        "| term | unit | meaning | adds to the indicated specific force | shown by | known size |",
        "|---|---|---|---|---|---|",
    ]
    for name, words in TERM_WORDS.items():
        unit = "g" if name in ("sn", "cn") else UNITS[name]
        meaning, formula = cell(words.meaning), cell(words.formula)
        rows.append(
            f"| `{name}` | {unit} | {meaning} | `{formula}` | {cell(words.shown_by)} | {cell(words.known)} |"
        )
    lead = (
        "`piga terms` prints this table. A size is given where a source or the physics gives one: "
        "[sources](../../references.md), [servo](../../understanding/servo.md). It decides nothing."
    )
    return f"# Terms of the error model\n\n{lead}\n\n" + "\n".join(rows) + "\n"


# --- schemas -------------------------------------------------------------------------------------------


def json_page() -> str:
    """What every command prints with ``--json``."""
    parts = [JSON_HEAD]
    for path in sorted(JSON_SCHEMAS.glob("*.json"), key=lambda path: path.stem):
        schema = json.loads(path.read_text(encoding="utf-8"))
        top, start = (schema["items"], "[].") if schema["type"] == "array" else (schema, "")
        rows = ["| member | type |", "|---|---|"]
        rows += [f"| `{where}` | {words or kind} |" for where, kind, words in schema_rows(top, top, start)]
        parts.append(f"## {path.stem.replace('-', ' ')}\n\n" + "\n".join(rows) + "\n")
    return "\n".join(parts)


def schema_rows(node: dict[str, Any], root: dict[str, Any], path: str) -> Iterator[tuple[str, str, str]]:
    """Name, type and meaning of the members of an object; members of arrays behind ``[]``, of names from the data behind ``*``."""
    for name, one in node.get("properties", {}).items():
        member, where = resolve(one, root), f"{path}{name}"
        kind = member.get("type", "value")
        kind = " or ".join(kind) if isinstance(kind, list) else kind
        yield where, kind, f"`{member['const']}`" if "const" in member else cell(member.get("description", ""))
        yield from schema_rows(member, root, f"{where}.")
        if isinstance(member.get("additionalProperties"), dict):
            yield from schema_rows(member["additionalProperties"], root, f"{where}.*.")
        if "items" in member:
            yield from schema_rows(resolve(member["items"], root), root, f"{where}[].")


def resolve(node: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    """Follow a reference within the same schema."""
    reference = node.get("$ref")
    if reference is None:
        return node
    for part in reference.removeprefix("#/").split("/"):
        root = root[part]
    return {**root, **{key: value for key, value in node.items() if key != "$ref"}}
