"""drawable: text with nothing in it that the viewer's font lacks; a viewer without a window dies of such a sign."""

import unicodedata

# The viewer draws in Inter. It holds these, first to last; a few rare signs that it has too are not listed.
_RANGES = (
    (0x0020, 0x007E), (0x00A0, 0x0148), (0x014A, 0x01C3), (0x01C5, 0x031E), (0x0384, 0x038A), (0x038E, 0x03A1),
    (0x03A3, 0x03E1), (0x03F0, 0x049D), (0x04A0, 0x04FF), (0x1E00, 0x1F15), (0x2010, 0x2027), (0x202F, 0x205F),
    (0x2074, 0x208E), (0x2090, 0x209C), (0x20A0, 0x20BF), (0x2190, 0x2199), (0x2264, 0x2265),
)  # fmt: skip
_SINGLE = "\n\t⁰ⁱᵏᵢᵣᵤᵥₓ℃ℓ№™Ω⇒⇔∂∅∆∏∑−√∞∫≈≠■▲▶▼◆●★✓✗"
_HELD = frozenset(_SINGLE).union(*(map(chr, range(first, last + 1)) for first, last in _RANGES))
_WORDS = {"ᵀ": "^T", "ᴴ": "^H", "∇": "grad ", "∈": " in ", "⟨": "<", "⟩": ">", "⊤": "^T", "⋅": "·", "∣": "|"}
_UNKNOWN = "?"


def drawable(text: str) -> str:
    """Return `text` with each sign that the viewer's font lacks spelled otherwise: 𝜓 is ψ, Uᵀ is U^T, the rest "?"."""
    return "".join(sign if sign in _HELD else _spelled(sign) for sign in text)


def _spelled(sign: str) -> str:
    plain = _WORDS.get(sign) or unicodedata.normalize("NFKC", sign)
    return plain if _HELD.issuperset(plain) else _UNKNOWN
