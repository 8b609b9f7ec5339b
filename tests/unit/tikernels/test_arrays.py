"""Host functions say what they take and return; of kernels no type checker can ask it."""

import ast
from pathlib import Path

import numpy as np
from support.array_forms import on_device

import tikernels
from tikernels import runtime
from tikernels._taichi import ti

ROOT = Path(tikernels.__file__).parent
SOURCES = sorted(path for path in ROOT.rglob("*.py") if path.name not in ("_taichi.py", "lazy_names.py"))
Function = ast.FunctionDef


def names_in(annotation: ast.expr) -> set[str]:
    """Return the names in an annotation, those in quotes, too."""
    text = annotation.value if isinstance(annotation, ast.Constant) else ast.unparse(annotation)
    return {node.id for node in ast.walk(ast.parse(str(text))) if isinstance(node, ast.Name)}


def host_functions(path: Path) -> list[Function]:
    """Return functions and methods, but not what stands in a function, nor kernels and their functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    inside = [node for outer in tree.body for node in (outer.body if isinstance(outer, ast.ClassDef) else [outer])]
    found = [node for node in inside if isinstance(node, Function)]
    return [
        node
        for node in found
        if not {ast.unparse(d).partition("(")[0] for d in node.decorator_list} & {"kernel", "ti.func"}
    ]


HOST_FUNCTIONS = [(path, function) for path in SOURCES for function in host_functions(path)]


def test_host_functions_are_annotated():
    for path, function in HOST_FUNCTIONS:
        arguments = (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
        bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
        assert not bare, f"{path}: {function.name} does not say what {bare} are"
        assert function.returns is not None, f"{path}: {function.name} does not say what it returns"


def test_public_functions_name_the_elements_of_arrays():
    """What is taken and returned; only a cached factory returns anything, a kernel or a function for kernels."""
    for path, function in HOST_FUNCTIONS:
        if function.name.startswith("_"):
            continue
        arguments = (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
        vague = [a.arg for a in arguments if a.annotation and "Any" in names_in(a.annotation)]
        assert not vague, f"{path}: {function.name} takes anything as {vague}"
        if "cache" not in {ast.unparse(d) for d in function.decorator_list}:
            assert "Any" not in names_in(function.returns), f"{path}: {function.name} may return anything"


def test_a_device_array_has_what_the_protocol_says(arch):
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    buffer = on_device(values)
    assert tuple(buffer.shape) == (2, 3) and buffer.element_type == ti.f32
    np.testing.assert_array_equal(buffer.to_numpy(), values)
    buffer.from_numpy(2 * values)
    np.testing.assert_array_equal(runtime.to_host(buffer), 2 * values)
    buffer.fill(3)
    np.testing.assert_array_equal(runtime.to_host(buffer), 3)
