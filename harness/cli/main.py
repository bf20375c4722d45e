"""The command `motorhil`: one verb per module, loaded when it is used.

Exit status, the same for every verb: 0 passed, 1 the thing under test failed, 2 wrong usage, 3
nothing could be judged, 130 interrupted, 141 the reader of its results left. Results go to stdout,
reasons to stderr. The module of a verb has `add_arguments(parser)` and `run(arguments)`. Words
after `--` on the command line are `arguments.rest`, which is None without `--`.
"""

import argparse
import errno
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from io import TextIOWrapper
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.cli.printable import printable, printable_streams

PASSED: Final = 0
FAILED: Final = 1  # the thing under test failed
WRONG_USAGE: Final = 2
NOT_JUDGED: Final = 3  # there was nothing to test: neither passed nor failed
INTERRUPTED: Final = 130  # 128 and SIGINT, as of a shell
READER_LEFT: Final = 141  # 128 and SIGPIPE


_NO_PLACE: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


@final
@frozen
class _Verb:
    name: str
    help: str
    module: str
    takes_rest: bool = False
    is_terminal: bool = False  # it prints what programs print, or progress on one line
    reads: tuple[str, ...] = ()  # options that name the recordings it reads: it shows its progress

    def exists(self) -> bool:
        return find_spec(self.module) is not None


_VERBS: Final = (
    _Verb(
        "demo",
        "a six-wheel rover drives, crabs and turns on emulated drives",
        "motorhil.harness.cli.demo",
        is_terminal=True,
    ),
    _Verb("new", "write a working rig, and a script that drives it", "motorhil.harness.cli.new"),
    _Verb(
        "check", "check a rig file: print its errors, or its contents", "motorhil.harness.cli.check"
    ),
    _Verb(
        "run",
        "run a script, or a prompt, with a rig around it",
        "motorhil.harness.cli.run",
        takes_rest=True,
        is_terminal=True,
    ),
    _Verb(
        "serve",
        "run a rig in real time for other processes",
        "motorhil.harness.cli.serve",
        takes_rest=True,
        is_terminal=True,
    ),
    _Verb("record", "record live CAN buses", "motorhil.harness.cli.record", is_terminal=True),
    _Verb(
        "replay",
        "let a recording stand in for devices or host",
        "motorhil.harness.cli.replay",
        takes_rest=True,
        is_terminal=True,
    ),
    _Verb("recover", "repair a cut or damaged recording", "motorhil.harness.cli.recover"),
    _Verb("show", "print a recording as sentences", "motorhil.harness.cli.show", reads=("file",)),
    _Verb(
        "diff",
        "find the first difference between two recordings",
        "motorhil.harness.cli.diff",
        reads=("first", "second"),
    ),
    _Verb(
        "conform",
        "check whether an adaptation fulfils the motor interface",
        "motorhil.harness.cli.conform",
        is_terminal=True,
    ),
    _Verb(
        "swarm",
        "run a program in many disturbed worlds, and keep what breaks it",
        "motorhil.harness.cli.swarm",
        takes_rest=True,
        is_terminal=True,
    ),
    _Verb(
        "judge",
        "judge a recording by rules that every recording must meet",
        "motorhil.harness.cli.judge",
        reads=("file",),
    ),
    _Verb(
        "analyse",
        "check whether every message on a CAN bus meets its deadline",
        "motorhil.harness.cli.analyse",
        reads=("file",),
    ),
    _Verb(
        "report",
        "draw a recording on one page, on one time axis",
        "motorhil.harness.cli.report",
        reads=("file",),
    ),
    _Verb(
        "view",
        "watch a recording, a rig or a live bus on a page",
        "motorhil.harness.cli.view",
        takes_rest=True,
        is_terminal=True,
    ),
    _Verb(
        "identify",
        "find inertia and friction of a motor in its recording",
        "motorhil.harness.cli.identify",
        reads=("file",),
    ),
    _Verb(
        "convert",
        "turn recorded CAN traffic into another format",
        "motorhil.harness.cli.convert",
        reads=("source",),
    ),
    _Verb(
        "list",
        "list controllers, adaptations, examples, motors",
        "motorhil.harness.cli.list",
    ),
    _Verb(
        "completion",
        "print a script by which a shell completes this command",
        "motorhil.harness.cli.completion",
    ),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    _open_standard_streams()
    try:
        status = _dispatch(words)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("motorhil: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has left
        _drop_output()
        return READER_LEFT
    except OSError as error:
        if error.filename is not None or error.errno not in _NO_PLACE:
            raise
        _drop_output()
        print(
            f"motorhil: standard output cannot be written: {error.strerror}; free space there, "
            "or send it elsewhere",
            file=sys.stderr,
        )
        return WRONG_USAGE
    if isinstance(sys.stdout, _NoOutput) and sys.stdout.is_missed:
        print(
            "motorhil: standard output is closed, and its results are lost; send it to a file or "
            "a pipe",
            file=sys.stderr,
        )
        return status or WRONG_USAGE
    return status


@final
class _NoOutput(TextIOWrapper):
    """The null device in place of a closed standard output.

    Attributes:
        is_missed: True if results were printed.
    """

    is_missed = False

    def write(self, text: str) -> int:
        self.is_missed = True
        return super().write(text)


def _open_standard_streams() -> None:
    """Open the null device for each standard stream that the process lacks."""
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: SIM115  # for the rest of the process
    if sys.stdout is None:
        sys.stdout = _NoOutput(open(os.devnull, "wb"))  # noqa: SIM115  # likewise
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115  # likewise


def _drop_output() -> None:
    """Redirect stdout to the null device, including the flush at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _dispatch(words: list[str]) -> int:
    try:
        return _obey(words)
    except SystemExit as leaving:  # argparse: help was printed, or the usage is wrong
        return leaving.code if isinstance(leaving.code, int) else PASSED


def _obey(words: list[str]) -> int:
    verbs = {verb.name: verb for verb in _VERBS if verb.exists()}
    top = argparse.ArgumentParser(
        prog="motorhil", description="Motor code on emulated drives, in virtual time."
    )
    top.add_argument("--version", action="store_true", help="print the version and which cores run")
    commands = top.add_subparsers(metavar="VERB", dest="verb")
    for verb in verbs.values():
        commands.add_parser(verb.name, help=verb.help, add_help=False)
    if words[:1] == ["help"]:
        words = [*words[1:2], "--help"]
    _refuse_unknown(words[:1], list(verbs))
    options = top.parse_args(words[:1])
    if options.version:
        return _print_version()
    if options.verb is None:
        top.print_help(sys.stderr)
        return WRONG_USAGE
    return _run_verb(verbs[options.verb], words[1:])


def _refuse_unknown(words: list[str], verbs: list[str]) -> None:
    """Leave with the nearest verb if the word is none."""
    for word in words:
        if not word.startswith("-") and word not in verbs:
            near = get_close_matches(word, verbs, 1, 0.5)
            hint = f"did you mean 'motorhil {near[0]}'?" if near else "see 'motorhil help'"
            print(f"motorhil: {printable(word)!r} is not a verb; {hint}", file=sys.stderr)
            raise SystemExit(WRONG_USAGE)


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Return the parser of each verb, by its name; this imports all of them."""
    return {verb.name: _parser_of(verb) for verb in _VERBS if verb.exists()}


def _parser_of(verb: _Verb) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"motorhil {verb.name}",
        description=verb.help[0].upper() + verb.help[1:] + ".",
        allow_abbrev=False,
    )
    import_module(verb.module).add_arguments(parser)
    return parser


def _run_verb(verb: _Verb, words: list[str]) -> int:
    from motorhil.harness.rig.config.toml import RigError
    from motorhil.traces.errors import TraceError

    module, parser = import_module(verb.module), _parser_of(verb)
    rest: list[str] | None = None
    if verb.takes_rest and "--" in words:
        cut = words.index("--")
        words, rest = words[:cut], words[cut + 1 :]
    options = parser.parse_intermixed_args(words)
    options.rest = rest
    with (
        nullcontext() if verb.is_terminal else printable_streams(),
        _progress(verb, options),
    ):
        try:
            status: int = module.run(options)
        except (RigError, TraceError) as error:
            print(printable(str(error)), file=sys.stderr)
            return WRONG_USAGE
    if verb.is_terminal and isinstance(sys.stdout, _NoOutput):
        sys.stdout.is_missed = False  # it may have been what a program prints
    return status


def _progress(verb: _Verb, options: argparse.Namespace) -> AbstractContextManager[None]:
    """Return a context that shows how far the verb has read its recordings."""
    from motorhil.harness.cli.progress import following

    paths = [getattr(options, name) for name in verb.reads]
    # `show` prints lines of its own on the same terminal, and may never end
    prints = verb.name == "show" and (sys.stdout.isatty() or options.follow)
    if None in paths or not paths or prints:
        return nullcontext()
    return following(verb.name, [os.fspath(path) for path in paths])


def _print_version() -> int:
    from motorhil.harness.version import describe

    print(describe())
    return PASSED
