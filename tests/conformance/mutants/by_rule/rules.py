"""Rules: the small changes of a syntax tree that a mutant consists of.

An edit changes the tree in place, and back. Annotations, decorators, docstrings and format
specifications stay as they are.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

_SWAPPED: Final[dict[type[ast.AST], tuple[str, type[ast.AST]]]] = {
    ast.Add: ("operator", ast.Sub),
    ast.Sub: ("operator", ast.Add),
    ast.Mult: ("operator", ast.Div),
    ast.Div: ("operator", ast.Mult),
    ast.And: ("operator", ast.Or),
    ast.Or: ("operator", ast.And),
    ast.Lt: ("comparison", ast.LtE),
    ast.LtE: ("comparison", ast.Lt),
    ast.Gt: ("comparison", ast.GtE),
    ast.GtE: ("comparison", ast.Gt),
    ast.Eq: ("comparison", ast.NotEq),
    ast.NotEq: ("comparison", ast.Eq),
    ast.Is: ("comparison", ast.IsNot),
    ast.IsNot: ("comparison", ast.Is),
    ast.In: ("comparison", ast.NotIn),
    ast.NotIn: ("comparison", ast.In),
}
_UNIT_FACTORS: Final = {1e9: 1e6, 1e6: 1e9, 1e3: 1e6, 1e-9: 1e-6, 1e-6: 1e-9, 1e-3: 1e-6}
_FUNCTIONS: Final = (ast.FunctionDef, ast.AsyncFunctionDef)
_SKIPPED: Final = ("annotation", "returns", "decorator_list", "format_spec", "type_params")
_WINDOW: Final = 100  # characters of a change that are shown whole
_MARGIN: Final = 36  # characters shown on either side of a difference in a longer one


@dataclass(frozen=True, slots=True)
class Edit:
    """One change of a tree.

    Attributes:
        rule: the name of the rule.
        owner, field, place: the changed field of a node, and the index if it is a list.
        new: the new value.
        statement: the innermost statement around it.
        function: the outermost function around it, or None at the level of modules and classes.
        scope: its name, such as "Motor.start"; that of a class or "<module>" if there is none.
    """

    rule: str
    owner: ast.AST
    field: str
    place: int | None
    new: Any
    statement: ast.stmt
    function: ast.FunctionDef | ast.AsyncFunctionDef | None
    scope: str

    def apply(self) -> Any:
        """Change the tree; return the former value."""
        values = getattr(self.owner, self.field)
        if self.place is None:
            former = values
            setattr(self.owner, self.field, self.new)
        else:
            former = values[self.place]
            values[self.place] = self.new
        return former

    def change(self) -> str:
        """Return the text before and after, "before -> after"; leave the tree as it was."""
        before = self._shown()
        former = self.apply()
        after = "..." if isinstance(self.new, ast.Pass) else self._shown()
        if self.place is None:
            setattr(self.owner, self.field, former)
        else:
            getattr(self.owner, self.field)[self.place] = former
        return " -> ".join(_window(before, after))

    def _shown(self) -> str:
        if isinstance(self.new, ast.Pass):
            return ast.unparse(self.statement)
        if isinstance(self.owner, ast.If | ast.While | ast.Assert):
            return f"{type(self.owner).__name__.lower()} {ast.unparse(self.owner.test)}"
        if isinstance(self.owner, ast.stmt) and hasattr(self.owner, "body"):
            return ast.unparse(getattr(self.owner, self.field))
        if isinstance(self.owner, ast.expr | ast.stmt | ast.arguments):
            return ast.unparse(self.owner)
        return ast.unparse(self.statement).split("\n")[0]


def _window(before: str, after: str) -> tuple[str, str]:
    """Return the parts around the difference, if the texts are long."""
    if max(len(before), len(after)) <= _WINDOW:
        return before, after
    if after == "...":
        return f"{before[:_WINDOW]}...", after
    same = min(len(before), len(after))
    first = next((n for n in range(same) if before[n] != after[n]), same)
    last = next((n for n in range(same - first) if before[-1 - n] != after[-1 - n]), same - first)

    def part(text: str) -> str:
        begin, end = max(first - _MARGIN, 0), min(len(text) - last + _MARGIN, len(text))
        return f"{'...' if begin else ''}{text[begin:end]}{'...' if end < len(text) else ''}"

    return part(before), part(after)


def edits(tree: ast.Module) -> Iterator[Edit]:
    """Yield all edits of a module, in the order of its text."""
    for node in tree.body:
        yield from _of_statement(node, tree, "body", "<module>", None)


def _of_statement(
    node: ast.stmt,
    owner: ast.AST,
    field: str,
    scope: str,
    function: ast.FunctionDef | ast.AsyncFunctionDef | None,
) -> Iterator[Edit]:
    def made(rule: str, at: ast.AST, field: str, place: int | None, new: Any) -> Edit:
        return Edit(rule, at, field, place, new, node, function, scope)

    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    yield from _dropped(node, owner, field, function is not None, made)
    if isinstance(node, ast.AugAssign):
        yield from _swapped(node, "op", None, node.op, made)
    inner, within = scope, function
    if function is None and isinstance(node, (*_FUNCTIONS, ast.ClassDef)):
        inner = node.name if scope == "<module>" else f"{scope}.{node.name}"
        within = node if isinstance(node, _FUNCTIONS) else None
    for name, value in ast.iter_fields(node):
        if name in _SKIPPED:
            continue
        for place, child in enumerate(value) if isinstance(value, list) else ((None, value),):
            if isinstance(child, ast.stmt):
                yield from _of_statement(child, node, name, inner, within)
            elif isinstance(child, ast.excepthandler | ast.match_case):
                for one in child.body:
                    yield from _of_statement(one, child, "body", inner, within)
            elif isinstance(child, ast.AST):
                yield from _of_expression(child, node, name, place, made)


def _dropped(node: ast.stmt, owner: ast.AST, field: str, in_function: bool, made) -> Iterator[Edit]:
    """Yield the edits that leave a statement out: a call, a raise, an early return."""
    is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call | ast.Await)
    is_raise = isinstance(node, ast.Raise)
    is_early = isinstance(node, ast.Return) and not isinstance(owner, _FUNCTIONS)
    if in_function and (is_call or is_raise or is_early):
        place = next(n for n, one in enumerate(getattr(owner, field)) if one is node)
        rule = "dropped call" if is_call else "dropped raise" if is_raise else "dropped return"
        yield made(rule, owner, field, place, ast.copy_location(ast.Pass(), node))


def _of_expression(node: ast.AST, owner: ast.AST, field: str, place, made) -> Iterator[Edit]:
    """Yield the edits of an expression and its parts."""
    for rule, new in _replacements(node):
        yield made(rule, owner, field, place, ast.copy_location(new, node))
    if field == "test" and isinstance(owner, ast.If | ast.While | ast.IfExp | ast.Assert):
        negated = ast.UnaryOp(ast.Not(), node)
        yield made("negated condition", owner, field, place, ast.copy_location(negated, node))
    if isinstance(node, ast.BinOp | ast.BoolOp):
        yield from _swapped(node, "op", None, node.op, made)
    if isinstance(node, ast.Compare):
        for number, operator in enumerate(node.ops):
            yield from _swapped(node, "ops", number, operator, made)
    if isinstance(node, ast.Call):
        for number in range(len(node.args) - 1):
            first, second = node.args[number : number + 2]
            if _are_of_a_kind(first, second):
                args = [*node.args[:number], second, first, *node.args[number + 2 :]]
                yield made("swapped arguments", node, "args", None, args)
    for name, value in ast.iter_fields(node):
        if name in _SKIPPED:
            continue
        for number, child in enumerate(value) if isinstance(value, list) else ((None, value),):
            if isinstance(child, ast.AST):
                yield from _of_expression(child, node, name, number, made)


def _swapped(node, field, place, operator, made) -> Iterator[Edit]:
    """Yield the edit that puts another operator in the place of this one."""
    if isinstance(operator, ast.Add) and _is_text(node):
        return
    rule, other = _SWAPPED.get(type(operator), ("", None))
    if other is not None:
        yield made(rule, node, field, place, other())


def _is_text(node: ast.AST) -> bool:
    sides = (node.left, node.right) if isinstance(node, ast.BinOp) else ()
    return any(
        isinstance(one, ast.JoinedStr | ast.List | ast.Tuple)
        or (isinstance(one, ast.Constant) and isinstance(one.value, str | bytes))
        for one in sides
    )


def _replacements(node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield expressions to put in the place of a node, with their rules."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield "operator", node.operand
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "constant", node.operand
    elif isinstance(node, ast.Await):
        yield "missing await", node.value
    elif isinstance(node, ast.Constant):
        for value in _other_values(node.value):
            yield "constant", ast.Constant(value)


def _other_values(value: object) -> tuple[object, ...]:
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, int):
        return (1 - value,) if value in (0, 1) else (value - 1, value + 1, 2 * value)
    if isinstance(value, float):
        if value in (0.0, 1.0):
            return (1.0 - value,)
        return (2.0 * value, -value, *filter(None, (_UNIT_FACTORS.get(value),)))
    return ()


def _are_of_a_kind(first: ast.expr, second: ast.expr) -> bool:
    """Return whether two arguments look as if one could be taken for the other."""
    names = ast.Name | ast.Attribute
    if isinstance(first, names) and isinstance(second, names):
        return ast.dump(first) != ast.dump(second)
    if isinstance(first, ast.Constant) and isinstance(second, ast.Constant):
        return type(first.value) is type(second.value) and first.value != second.value
    return False
