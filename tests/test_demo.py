"""What the command refuses before anything is served; tests/demonstration has the page itself."""

import pytest

from depthreg.cli import main


def test_without_gradio_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr("depthreg.demo.find_spec", lambda name: None)
    assert main(["demo"]) == 2
    printed = capsys.readouterr()
    assert "pip install 'depthreg[demo]'" in printed.err and len(printed.err.splitlines()) == 1 and not printed.out


def test_weights_that_are_not_there_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path, capsys) -> None:
    monkeypatch.setattr("depthreg.demo.find_spec", lambda name: True)
    assert main(["demo", "--checkpoint", str(tmp_path / "no.ckpt")]) == 2
    assert "no.ckpt does not exist" in capsys.readouterr().err
