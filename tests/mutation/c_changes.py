"""Changes of a C file: comparisons and operators swapped, other constants, statements left out, conditions turned round.

Each compiles: comments, directives, declarations' types and sizes stay as they are.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

from tests.mutation.changes import Mutant

TOKEN = re.compile(
    r"(?P<comment>/\*.*?\*/|//[^\n]*)|(?P<directive>^[ \t]*#(?:[^\n\\]|\\.|\\\n)*)|(?P<string>\"(?:[^\"\\]|\\.)*\"|'(?:[^'\\]|\\.)*')"
    r"|(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?[uUlLfF]*)|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign>->|\+\+|--|<<=|>>=|<<|>>|<=|>=|==|!=|&&|\|\||[-+*/%&|^]=|[-+*/%<>=!&|^~?:;,.(){}\[\]])",
    re.DOTALL | re.MULTILINE,
)
SWAPPED = {
    **{"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "&&": "||", "||": "&&"},
    **{"+": "-", "-": "+", "*": "/", "+=": "-=", "-=": "+=", "*=": "=", "|=": "&=", "&=": "|="},
}
OPERATOR = {"<": "Compare", ">": "Compare", "=": "Compare", "!": "Compare", "&": "BoolOp", "|": "BoolOp"}
TYPES = {"char", "const", "double", "float", "int", "koopmpc_real", "long", "size_t", "static", "unsigned", "void"}
TOLERANCE = re.compile(r"\b(?:KOOPMPC_[A-Z_]*(?:TOL|HUGE|EPS|SLACK)[A-Z_]*|\d+(?:\.\d*)?[eE]-\d+)")


@dataclass(frozen=True)
class Token:
    """A word, number, sign or string, and where it stands."""

    kind: str
    text: str
    start: int


def read_tokens(text: str) -> list[Token]:
    """Return the tokens of a file without comments and directives."""
    tokens = [Token(m.lastgroup or "", m.group(), m.start()) for m in TOKEN.finditer(text)]
    return [t for t in tokens if t.kind not in ("comment", "directive")]


def _is_value(token: Token) -> bool:
    return (token.kind in ("number", "word") and token.text not in TYPES | {"return"}) or token.text in (")", "]")


def _end_of(tokens: list[Token], i: int, opening: str, closing: str) -> int:
    """Return the place of the bracket that closes the one at i."""
    depth = 0
    for j in range(i, len(tokens)):
        depth += (tokens[j].text == opening) - (tokens[j].text == closing)
        if not depth:
            return j
    return len(tokens) - 1


def _casts(tokens: list[Token], i: int) -> bool:
    """Return whether the bracket before i closes a cast or the type of a declaration, so that a * is no product."""
    if tokens[i - 1].text != ")":
        return False
    j = i - 1
    while j >= 0 and tokens[j].text != "(":
        j -= 1
    return any(t.text in TYPES or t.text.endswith("_state") for t in tokens[j + 1 : i - 1])


def _declares(tokens: list[Token], i: int) -> bool:
    """Return whether token i stands in the type, the name or the size of a declaration, or in an enum."""
    j = i
    while j > 0 and tokens[j - 1].text not in (";", "{", "}"):
        j -= 1
    statement = tokens[j:i]
    enum = j > 1 and tokens[j - 1].text == "{" and tokens[j - 2].text == "enum"
    if enum or any(t.text in ("typedef", "struct") for t in statement):
        return True
    if not statement or statement[0].text not in TYPES:
        return False
    depth = 0  # a size stands in brackets before any =
    for t in reversed(statement):
        if t.text == "=":
            return False
        depth += (t.text == "[") - (t.text == "]")
        if depth > 0:
            return True
    return False


def c_mutants(file: str, source: bytes) -> Iterator[Mutant]:
    """Yield every change of this file."""
    text = source.decode()
    tokens, offset = read_tokens(text), [0]
    for character in text:
        offset.append(offset[-1] + len(character.encode()))

    def change(operator: str, first: int, last: int, new: str) -> Mutant:
        start, end = tokens[first].start, tokens[last].start + len(tokens[last].text)
        lines = text.count("\n", 0, start) + 1, text.count("\n", 0, end) + 1
        return Mutant(file, *lines, offset[start], offset[end], new, operator)

    depth = bracket = 0
    for i, token in enumerate(tokens[:-1]):
        depth += (token.text == "{") - (token.text == "}")
        bracket += (token.text == "(") - (token.text == ")")
        if not i or not depth or _declares(tokens, i):
            continue
        before, after = tokens[i - 1], tokens[i + 1]
        line = text[text.rfind("\n", 0, token.start) + 1 : text.find("\n", token.start)]
        if token.text in SWAPPED and _is_value(before) and not (token.text in "*&" and _casts(tokens, i)):
            compared = token.text in ("<", "<=", ">", ">=")
            if not (compared and TOLERANCE.search(line)) and (token.text != "*" or after.text not in (",", ")", "*")):
                operator = OPERATOR.get(token.text[0], "BinOp" if len(token.text) == 1 else "AugAssign")
                yield change(operator, i, i, SWAPPED[token.text])
        elif token.kind == "number" and not re.search(r"[eE]-", token.text):
            whole = re.fullmatch(r"\d+", token.text)
            yield change("Constant", i, i, str(int(token.text) + 1) if whole else f"(2 * {token.text})")
        elif token.text in ("if", "while") and after.text == "(":
            end = _end_of(tokens, i + 1, "(", ")")
            if tokens[end + 1].text != ";":
                inside = text[after.start : tokens[end].start + 1]
                yield change("If", i + 1, end, f"(!{inside})")
        elif token.text == "return" and after.text != ";":
            end = next(j for j in range(i, len(tokens)) if tokens[j].text == ";")
            if text[after.start : tokens[end].start].strip() != "0":
                yield change("Return", i, end, "return 0;")
        elif token.text in ("continue", "break") and before.text in (")", ";", "{", "else"):
            yield change("Expr", i, i, "")
        elif token.kind == "word" and not bracket and before.text in (";", "{", "}", ")", "else"):
            end = next((j for j in range(i, len(tokens)) if tokens[j].text in (";", "{", "}")), i)
            head = [t.text for t in tokens[i : i + 2]]
            if tokens[end].text != ";" or head[0] in TYPES | {
                "if",
                "for",
                "while",
                "return",
                "do",
                "case",
                "default",
                "else",
            }:
                continue
            if before.text == ")" and not _heads(tokens, i - 1):
                continue
            if head[1] in ("=", "[", "->", ".", "+=", "-=", "*=", "|=", "&=", "++", "--", "("):
                yield change("Expr" if head[1] == "(" else "Assign", i, end, ";")


def _heads(tokens: list[Token], i: int) -> bool:
    """Return whether the bracket that ends at i is that of an if, a for or a while."""
    depth = 0
    for j in range(i, -1, -1):
        depth += (tokens[j].text == ")") - (tokens[j].text == "(")
        if not depth:
            return j > 0 and tokens[j - 1].text in ("if", "for", "while")
    return False
