"""`sonarpost completion`: the script of each shell, run by the shell where it is installed."""

import shutil
import subprocess

import pytest

from sonarpost.cli.main import main
from sonarpost.cli.parsing.commands import COMMANDS


def script(shell, capsys):
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def completed(text, folder, *words):
    """Return what bash offers after `sonarpost WORDS`; the last word is the one to complete."""
    (folder / "script").write_text(text)
    program = 'source ./script; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _sonarpost; printf "%s\\n" "${COMPREPLY[@]}"'
    command = ["bash", "-uc", program, "bash", "sonarpost", *words]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.split()


def test_bash_completes_commands_actions_options_and_values(tmp_path, capsys):
    text = script("bash", capsys)
    assert set(completed(text, tmp_path, "")) >= {*COMMANDS, "--version", "-v"}
    assert completed(text, tmp_path, "enc") == ["encode"]
    assert completed(text, tmp_path, "-q", "c2", "ex") == ["export"]
    assert completed(text, tmp_path, "console", "user", "pass") == ["passwd"]
    assert completed(text, tmp_path, "encode", "a.png", "--codeb") == ["--codebook"]
    assert completed(text, tmp_path, "pki", "prepare", "uuv-8", "--role", "ve") == ["vessel"]
    assert completed(text, tmp_path, "run", "comp") == ["compressor"]
    assert completed(text, tmp_path, "encode", "photo.p") == []


def test_bash_loads_the_script_and_registers_it(tmp_path, capsys):
    (tmp_path / "script").write_text(script("bash", capsys))
    command = ["bash", "-euc", "source ./script; complete -p sonarpost"]
    printed = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert printed == "complete -o default -F _sonarpost sonarpost\n"


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_zsh_and_fish_accept_their_script(shell, tmp_path, capsys):
    text = script(shell, capsys)
    assert "router-config" in text
    assert "nominal" not in text
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"{shell} is not installed")
    (tmp_path / "script").write_text(text)
    subprocess.run([program, "-n", str(tmp_path / "script")], check=True, capture_output=True)
    if shell == "fish":
        command = [program, "-c", "source script; complete -C 'sonarpost console user pass'"]
        printed = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
        assert printed.split() == ["passwd"]


def test_an_unknown_shell_is_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["completion", "zhs"])
    assert "did you mean zsh?" in capsys.readouterr().err
