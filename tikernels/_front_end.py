"""Make Taichi 1.7.4 read decorated functions once: two thirds of its time, and 0.3 s less for importing all kernels.

For each decorated function Taichi searches all loaded modules for the line around it, only to find out whether it is
in a class. At each of the 700 calls that a frame's kernels inline it reads and parses the called function again. At
each node it draws the source line, in case an error has to show it. Here the frame is queried instead, a function is
parsed once, and errors name the line. What kernels compute, and which errors they raise, stays the same.
"""

import ast
import functools
import importlib
import inspect
import linecache
import operator
import sys
import textwrap
import traceback
from typing import Any

contexts: Any = importlib.import_module("taichi.lang.ast.ast_transformer_utils")
kernels: Any = importlib.import_module("taichi.lang.kernel_impl")
implementation: Any = importlib.import_module("taichi.lang.impl")
transformer: Any = importlib.import_module("taichi.lang.ast.ast_transformer").ASTTransformer

_transform: Any = kernels.transform_tree
_build_attribute: Any = transformer.build_Attribute


def read_sooner() -> None:
    """Put the functions below in place of Taichi's."""
    kernels._inside_class = _inside_class
    kernels._get_tree_and_ctx = _tree_and_context
    kernels.transform_tree = _transform_once
    transformer.build_Attribute, transformer.build_Name = staticmethod(_attribute), staticmethod(_name)
    contexts.Builder.__call__ = _visit
    contexts.ASTTransformerContext.get_pos_info = _place


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Return whether a function is decorated in the body of a class, given the level of the frame outside it."""
    try:
        body = sys._getframe(level_of_class_stackframe - 1)
    except ValueError:
        return False
    # Functions have optimised locals; of the rest, modules have no qualified name.
    return not body.f_code.co_flags & inspect.CO_OPTIMIZED and "__qualname__" in body.f_locals


def _parse(function: Any) -> tuple[ast.Module, list[str], int, str]:
    """Return a function's tree without decorators, its lines, the number of the first one, and its file."""
    code, file = function.__code__, kernels.getsourcefile(function)
    first, last = code.co_firstlineno, max(filter(None, map(operator.itemgetter(1), code.co_positions())), default=0)
    # Python finds a function's end by its tokens, which takes as long as parsing it twice.
    lines = linecache.getlines(file, function.__globals__)[first - 1 : last]
    lines = [line.rstrip().expandtabs(4) for line in lines or kernels.getsourcelines(function)[0]]
    tree = ast.parse(textwrap.dedent("\n".join(lines)))
    tree.body[0].decorator_list = []  # type: ignore[attr-defined]
    return tree, lines, first, file


_parsed = functools.cache(_parse)


def _tree_and_context(
    self: Any,
    excluded_parameters: Any = (),
    is_kernel: bool = True,
    arg_features: Any = None,
    args: Any = None,
    ast_builder: Any = None,
    is_real_function: bool = False,
) -> tuple[ast.Module, Any]:
    """Do what Taichi's `_get_tree_and_ctx` does."""
    # Taichi takes a kernel's arguments out of its tree, which serves one of its variants.
    tree, lines, first, file = (_parse if is_kernel or is_real_function else _parsed)(self.func)
    if getattr(tree, "in_use", False):  # the function calls itself, as far as the compiler follows it
        tree, lines, first, file = _parse(self.func)
    variables = kernels._get_global_vars(self.func)
    if is_kernel or is_real_function:
        for place in self.template_slot_locations:
            variables[self.arguments[place].name] = args[place]
    context = contexts.ASTTransformerContext(
        excluded_parameters=excluded_parameters,
        is_kernel=is_kernel,
        func=self,
        arg_features=arg_features,
        global_vars=variables,
        argument_data=args,
        src=lines,
        start_lineno=first,
        file=file,
        ast_builder=ast_builder,
        is_real_function=is_real_function,
    )
    return tree, context


def _transform_once(tree: Any, context: Any) -> Any:
    """Transform a tree for one call at a time: Taichi notes in its nodes what has become of them."""
    tree.in_use = True
    try:
        return _transform(tree, context)
    finally:
        tree.in_use = False


def _name(context: Any, node: Any) -> Any:
    """Do what `build_Name` does, which notes the place in what is read as well."""
    node.ptr = context.get_var_by_name(node.id)
    return node.ptr


def _attribute(context: Any, node: Any) -> Any:
    """Do what `build_Attribute` does, which notes the vector whose method is called, but not that none is."""
    vars(node).pop("caller", None)
    return _build_attribute(context, node)


@functools.cache
def _builder(kind: type[ast.AST]) -> Any:
    """Return what transforms nodes of a kind."""
    method = getattr(transformer, "build_" + kind.__name__, None)
    if method is None:
        raise contexts.TaichiSyntaxError(f'Unsupported node "{kind.__name__}"')
    return method


def _place(self: Any, node: Any) -> str:
    """Return where a node is, without a drawing of its line; noted in the node."""
    place: str | None = vars(node).get("place")
    if place is None:
        place = f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {self.func.func.__name__}:\n'
        node.place = place
    return place


def _visit(self: Any, context: Any, node: Any) -> Any:
    """Do what `Builder.__call__` does."""
    places = implementation.pytaichi.src_info_stack
    visible = isinstance(node, (ast.stmt, ast.expr))
    places.append(context.get_pos_info(node) if visible else "")
    try:
        return _builder(node.__class__)(context, node)
    except Exception as error:
        if implementation.pytaichi.print_full_traceback:
            raise
        if context.raised or not visible:
            raise error.with_traceback(None)  # noqa: B904 - it is the same error
        context.raised = True
        raised = contexts.handle_exception_from_cpp(error)
        if not isinstance(raised, contexts.TaichiCompilationError):
            raise contexts.TaichiCompilationError(context.get_pos_info(node) + traceback.format_exc()) from None
        raise type(raised)(context.get_pos_info(node) + str(raised)) from None
    finally:
        places.pop()
