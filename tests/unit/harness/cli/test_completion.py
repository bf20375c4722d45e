"""The completion scripts, run by the shells for which they are."""

import shutil
import subprocess

import pytest

from motorhil.harness.cli.main import main, parsers

ASK = """
source completion.bash
COMP_WORDS=({words} "{current}")
COMP_CWORD=$(( ${{#COMP_WORDS[@]}} - 1 ))
complete -p motorhil >&2
$(complete -p motorhil | sed 's/.*-F \\([^ ]*\\).*/\\1/') motorhil "{current}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def script(shell, capsys):
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def completed(folder, words, current):
    ask = ASK.format(words=words, current=current)
    done = subprocess.run(
        ["bash", "--norc", "-c", ask], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.stderr == "complete -o default -F _motorhil motorhil\n"
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "current", "found"),
    [
        ("motorhil", "re", ["record", "replay", "recover", "report"]),
        ("motorhil", "h", ["help"]),
        ("motorhil show", "--f", ["--from", "--follow"]),
        ("motorhil replay x.mcap --as", "d", ["device"]),
        ("motorhil list", "co", ["controllers"]),
        ("motorhil show", "x.m", []),  # a file, by bash itself
        ("motorhil run rig.toml -- ", "--f", []),  # the program's own
    ],
)
def test_bash_completes_verbs_options_and_choices(tmp_path, capsys, words, current, found):
    (tmp_path / "completion.bash").write_text(script("bash", capsys))
    assert completed(tmp_path, words, current) == found


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_script_names_every_verb_and_every_option(shell, capsys):
    text = script(shell, capsys)
    for name, parser in parsers().items():
        assert name in text
        for action in parser._actions:
            for word in action.option_strings:
                assert (word if shell != "fish" else word.lstrip("-")) in text


@pytest.mark.parametrize(("shell", "words"), [("zsh", ["-n"]), ("fish", ["--no-execute"])])
def test_script_is_valid_for_its_shell(tmp_path, capsys, shell, words):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    path = tmp_path / "completion"
    path.write_text(script(shell, capsys))
    subprocess.run([shell, *words, str(path)], check=True)
