"""The verb `completion`: prints a script by which a shell completes verbs, options and choices.

The script is made of the parsers of all verbs, and starts no Python while the shell completes. A
word that is neither an option nor a choice is completed as a file.
"""

import argparse
from collections.abc import Iterable, Mapping

from motorhil.harness.cli.main import PASSED, parsers

_BASH = """\
# Completion of motorhil for bash: source <(motorhil completion bash)
_motorhil() {{
    local current="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" words="" word
    for word in "${{COMP_WORDS[@]:1:COMP_CWORD-1}}"; do
        if [ "$word" = -- ]; then return; fi
    done
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{verbs}"
    else
        case "${{COMP_WORDS[1]}} $before" in
{values}
        *) case "${{COMP_WORDS[1]}} $current" in
{options}
        {others}
        esac ;;
        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _motorhil motorhil
"""
_ZSH = """\
# Completion of motorhil for zsh: source <(motorhil completion zsh), after compinit
autoload -U +X bashcompinit && bashcompinit
"""
_FISH = "# Completion of motorhil for fish: motorhil completion fish | source"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument of `completion`."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell")
    parser.epilog = "Add to ~/.bashrc or ~/.zshrc: source <(motorhil completion bash)"


def run(options: argparse.Namespace) -> int:
    """Print the script."""
    verbs = parsers()
    if options.shell == "fish":
        print(_FISH, *_fish(verbs), sep="\n")
    else:
        print((_ZSH if options.shell == "zsh" else "") + _bash(verbs), end="")
    return PASSED


def _words(action: argparse.Action) -> list[str]:
    return [str(choice) for choice in action.choices or ()]


def _bash(verbs: Mapping[str, argparse.ArgumentParser]) -> str:
    values, options, positional = [], [], []
    for name, parser in verbs.items():
        names: list[str] = []
        for action in parser._actions:  # noqa: SLF001 -- argparse has no public list
            names += action.option_strings
            if action.choices and action.option_strings:
                places = "|".join(f'"{name} {word}"' for word in action.option_strings)
                values.append(f"""        {places}) words="{" ".join(_words(action))}" ;;""")
            elif action.choices:
                words = " ".join(_words(action))
                positional.append(f"""        "{name} "*) words="{words}" ;;""")
        options.append(f"""        "{name} -"*) words="{" ".join(names)}" ;;""")
    return _BASH.format(
        verbs=" ".join([*verbs, "help"]),
        values="\n".join(values),
        options="\n".join(options),
        others="\n".join(positional).strip(),
    )


def _fish(verbs: Mapping[str, argparse.ArgumentParser]) -> Iterable[str]:
    start = "complete -c motorhil"
    for name, parser in verbs.items():
        text = (parser.description or "").replace("'", "")
        yield f"{start} -n __fish_use_subcommand -f -a {name} -d '{text}'"
        for action in parser._actions:  # noqa: SLF001 -- argparse has no public list
            of_verb = f"{start} -n '__fish_seen_subcommand_from {name}'"
            words = f" -a '{' '.join(_words(action))}'" if action.choices else ""
            names = "".join(
                f" -l {one[2:]}" if one.startswith("--") else f" -s {one[1:]}"
                for one in action.option_strings
            )
            if names:
                takes = " -r" if action.nargs != 0 else ""
                yield f"{of_verb}{names}{takes}{' -f' + words if words else ''}"
            elif words:
                yield f"{of_verb} -f{words}"
