"""The examples need hardware, ROS or large packages: here they are compiled, and what they call of depthreg exists."""

import ast
from pathlib import Path

import pytest

import depthreg

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
if not EXAMPLES:
    pytest.skip("there are no examples beside these tests, as in the source archive", allow_module_level=True)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_compiles_and_loads_the_model_by_what_the_package_has(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"), path.name)
    compile(tree, path.name, "exec")
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "depthreg"
    }
    assert "load" in used and all(hasattr(depthreg, name) for name in used)
