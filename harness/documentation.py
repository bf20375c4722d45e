"""Pages for the site of the documents: copied from docs, and generated from the code.

    python -m motorhil.harness.documentation docs build/docs/source

copies the folder of documents, adds the generated pages of the reference, and adds navigation. The
navigation comes from the links in the `index.md` of each folder: a page without such a link is not
in it, and the build of the site fails (`make docs`).

Generated are `reference/cli.md` from the help of the command line, `reference/rig.md` from the JSON
Schema of rig files, and `reference/api.md` from the signatures and docstrings of public names.
"""

import enum
import inspect
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final
from unittest.mock import patch

from motorhil.harness.rig.config.schema import rig_schema

_LINK: Final = re.compile(r"\]\(([^)#\s]+\.md)\)")
_MODULES: Final = (
    "motorhil.motorapi",
    "motorhil.motorapi.api",
    "motorhil.motorapi.functions",
    "motorhil.motorapi.generation",
    "motorhil.motorapi.adaptations.cia402",
    "motorhil.motorapi.adaptations.host_servo",
    "motorhil.motorapi.adaptations.ideal",
    "motorhil.motorapi.adaptations.leadshine",
    "motorhil.motorapi.adaptations.oriental_az",
    "motorhil.motorapi.adaptations.rmd",
    "motorhil.motorapi.adaptations.vesc",
    "motorhil.emulators.api",
    "motorhil.traces.api",
)
_TELLING: Final = {"type", "description", "enum", "$ref", "oneOf", "anyOf"}
_SECTIONS: Final = ("Args", "Attributes", "Returns", "Raises", "Yields", "Source", "Shapes")


def main(words: Sequence[str]) -> int:
    """Build the sources of the site; return the exit status."""
    if len(words) != 2:
        print("usage: python -m motorhil.harness.documentation DOCS TARGET", file=sys.stderr)
        return 2
    build(Path(words[0]), Path(words[1]))
    return 0


def build(docs: Path, target: Path) -> None:
    """Copy the documents to `target`, which is emptied first, and add what is generated."""
    if target.exists():
        shutil.rmtree(target)
    shutil.copytree(docs, target)
    reference = target / "reference"
    generated = {"cli": command_line_page(), "rig": rig_page(), "api": api_page()}
    for name, page in generated.items():
        (reference / f"{name}.md").write_text(page, encoding="utf-8")
    titles = {"cli": "Command line", "rig": "Keys of the rig file", "api": "Python API"}
    links = "".join(f"- [{titles[name]}]({name}.md)\n" for name in generated)
    index = reference / "index.md"
    text = index.read_text(encoding="utf-8")
    index.write_text(f"{text}\n## Generated pages\n\n{links}", encoding="utf-8")
    for index in target.rglob("index.md"):
        _add_navigation(index, at_top=index.parent == target)


def _add_navigation(index: Path, *, at_top: bool) -> None:
    """Append a hidden table of contents with the pages that the index links to."""
    text = index.read_text(encoding="utf-8")
    links = list(dict.fromkeys(_LINK.findall(text)))
    if at_top:
        links = [link for link in links if link.endswith("/index.md")]
    pages = "".join(f"{link.removesuffix('.md')}\n" for link in links)
    index.write_text(f"{text}\n```{{toctree}}\n:hidden:\n\n{pages}```\n", encoding="utf-8")


# ---- command line ----


def command_line_page() -> str:
    """Return the page of all commands, with the help that each of them prints."""
    lines = [
        "# Command line",
        "",
        "This page is generated. Each section is the help of a command.",
        "",
    ]
    top = _help_of([])
    lines += ["## motorhil", "", *_fenced(top)]
    for verb in re.findall(r"^    (\w+)  ", top, re.MULTILINE):
        lines += [f"## motorhil {verb}", "", *_fenced(_help_of([verb]))]
    return "\n".join(lines)


def _help_of(words: list[str]) -> str:
    from motorhil.harness.cli.main import main as motorhil

    printed = io.StringIO()
    with redirect_stdout(printed), patch.dict(os.environ, COLUMNS="100"):
        motorhil([*words, "--help"])
    return printed.getvalue()


def _fenced(text: str) -> Iterator[str]:
    yield from ("```text", text.rstrip(), "```", "")


# ---- rig file ----


def rig_page() -> str:
    """Return the page of all tables and keys of the rig file."""
    return schema_page(rig_schema(), "Keys of the rig file")


def schema_page(schema: Mapping[str, Any], title: str) -> str:
    """Return a page for a JSON Schema: a section for each object, a row for each key.

    Any schema of objects will do. Sections are the root and each of `$defs`; nested objects and
    conditional parts (`allOf`, `anyOf`, `oneOf`, `then`, `else`) appear in the section around them.
    """
    lines = [f"# {title}", "", "This page is generated from the JSON Schema.", ""]
    lines += [*_described(schema)]
    lines += _section("Top level", schema)
    for name, part in schema.get("$defs", {}).items():
        lines += [f"## {name}", "", *_described(part)]
        lines += _section("", part)
    return "\n".join(lines)


def _described(part: Mapping[str, Any]) -> list[str]:
    return [_sentence(part["description"]), ""] if part.get("description") else []


def _section(heading: str, part: Mapping[str, Any]) -> list[str]:
    rows = list(_rows(part, "", set()))
    if not rows:
        return []
    head = [f"## {heading}", ""] if heading else []
    table = ["| key | type | default | description |", "| --- | --- | --- | --- |"]
    return [*head, *table, *rows, ""]


def _rows(part: Mapping[str, Any], prefix: str, seen: set[str]) -> Iterator[str]:
    """Yield a row for each key, once: conditional parts repeat keys only to constrain them."""
    required = part.get("required", ())
    for key, value in part.get("properties", {}).items():
        if not isinstance(value, Mapping):
            continue  # false: the key is not allowed here
        name = f"{prefix}{key}"
        if name not in seen and value.keys() & _TELLING:
            seen.add(name)
            cells = (
                f"`{name}`" + (" (required)" if key in required else ""),
                _type_of(value),
                _value(value["default"]) if "default" in value else "",
                _sentence(value.get("description", "")),
            )
            yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
        yield from _rows(value, f"{name}.", seen)
        for inner in (value.get("items"), value.get("additionalProperties")):
            if isinstance(inner, Mapping):
                yield from _rows(inner, f"{name}.NAME.", seen)
    parts = [one for word in ("allOf", "anyOf", "oneOf") for one in part.get(word, ())]
    for one in (*parts, part.get("then"), part.get("else")):
        if isinstance(one, Mapping):
            yield from _rows(one, prefix, seen)


def _type_of(part: Mapping[str, Any]) -> str:
    """Return the type of a value and its limits, as text."""
    if "$ref" in part:
        name = part["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in part:
        return _value(part["const"])
    if "enum" in part:
        return ", ".join(_value(one) for one in part["enum"])
    for word in ("oneOf", "anyOf"):
        if word in part and "type" not in part:
            kinds = [_type_of(one) for one in part[word] if isinstance(one, Mapping)]
            return " or ".join(dict.fromkeys(kind for kind in kinds if kind))
    kind = part.get("type", "")
    text = " or ".join(kind) if isinstance(kind, list) else str(kind)
    if text == "array" and isinstance(part.get("items"), Mapping):
        text = f"array of {_type_of(part['items']) or 'values'}"
    inner = part.get("additionalProperties")
    if text == "object" and isinstance(inner, Mapping) and _type_of(inner):
        text = f"object of {_type_of(inner)}"
    return f"{text}{_limits(part)}"


def _limits(part: Mapping[str, Any]) -> str:
    limits = []
    for word, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤")):
        if word in part:
            limits.append(f"{sign} {part[word]}")
    return f", {', '.join(limits)}" if limits else ""


def _value(value: object) -> str:
    return f"`{json.dumps(value)}`"


def _sentence(text: str) -> str:
    return _escaped(" ".join(text.split()))


# ---- Python API ----


def api_page() -> str:
    """Return the page of the public names of the motor interface."""
    lines = ["# Python API", "", "This page is generated from signatures and docstrings.", ""]
    documented: set[int] = set()
    for name in _MODULES:
        module = import_module(name)
        lines += [f"## {name}", "", *_docstring(module), *_members(module, documented)]
    return "\n".join(lines)


def _members(module: ModuleType, documented: set[int]) -> Iterator[str]:
    for name in getattr(module, "__all__", ()):
        value = getattr(module, name)
        if isinstance(value, ModuleType) or id(value) in documented:
            continue
        documented.add(id(value))
        if inspect.isclass(value):
            yield from _class(name, value)
        elif callable(value):
            yield from (f"### {name}", "", *_signature(name, value), *_docstring(value))
        else:
            yield from (f"### {name}", "", f"Value: {_escaped(repr(value))}", "")


def _class(name: str, kind: type) -> Iterator[str]:
    yield from (f"### {name}", "")
    if issubclass(kind, enum.Enum):
        yield from _docstring(kind)
        yield from ("Members: " + ", ".join(f"`{one.name}`" for one in kind) + ".", "")
    else:
        yield from (*_signature(name, kind), *_docstring(kind))
    for attribute, value in sorted(_public_attributes(kind)):
        if isinstance(value, property):
            yield from (f"#### {name}.{attribute} (property)", "", *_docstring(value.fget))
        else:
            yield from (f"#### {name}.{attribute}", "")
            yield from (*_signature(attribute, value), *_docstring(value))


def _public_attributes(kind: type) -> Iterator[tuple[str, Any]]:
    """Yield the methods and properties of a class, those of our own base classes included."""
    found: dict[str, Any] = {}
    for base in kind.__mro__:
        if base.__module__.split(".")[0] != "motorhil":
            continue
        for name, value in vars(base).items():
            plain = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if not name.startswith("_") and (
                inspect.isfunction(plain) or isinstance(plain, property)
            ):
                found.setdefault(name, plain)
    for name, value in found.items():
        if (value.fget if isinstance(value, property) else value).__doc__:
            yield name, value


def _signature(name: str, value: Any) -> Iterator[str]:
    if getattr(value, "_is_protocol", False):
        return
    try:
        text = str(inspect.signature(value))
    except (TypeError, ValueError):
        return
    short = re.sub(r"(?:\b[a-z_]\w*\.)+(?=[A-Za-z_])", "", text.replace("'", ""))
    short = re.sub(r"^\((?:self|cls)(?:, )?", "(", short)
    short = re.sub(r"<factory>|<[^<>]*>", "...", short)
    yield from ("```python", f"{name}{short}", "```", "")


def _docstring(value: Any) -> Iterator[str]:
    """Yield a docstring as Markdown: sections become bold, indented text becomes code."""
    text = inspect.cleandoc(getattr(value, "__doc__", None) or "")
    section, code = "", False
    for line in text.splitlines():
        heading = re.match(rf"({'|'.join(_SECTIONS)}): *(.*)$", line)
        indented = line.startswith("    ") and not section
        if indented != code and (line.strip() or not code):
            yield "```" if code else "```text"
            code = indented
        if heading:
            section = heading[1]
            yield from ("", f"**{section}:** {_escaped(heading[2])}".rstrip(), "")
        elif code:
            yield line[4:]
        elif section and re.match(r"    \S", line):
            yield f"- {_item(line.strip())}"
        elif not line.strip():
            yield ""
        else:
            section = section if line.startswith(" ") else ""
            yield _escaped(line) if not section else f"  {_escaped(line.strip())}"
    if code:
        yield "```"
    yield ""


def _item(text: str) -> str:
    name, colon, rest = text.partition(": ")
    if colon and re.fullmatch(r"[*\w, ()]+", name):
        return f"`{name}`: {_escaped(rest)}"
    return _escaped(text)


def _escaped(text: str) -> str:
    """Escape text for Markdown, its code spans excepted."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([\\<*_\[\]])", r"\\\1", part) for part in parts
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
