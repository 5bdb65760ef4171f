"""Format numbers with as many digits as their errors support, and shorten names."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from decimal import ROUND_CEILING, Decimal
from functools import partial
from itertools import zip_longest
from typing import NamedTuple

# Beyond these limits numbers are in scientific notation.
_MAX_DECIMALS = 6
_MIN_SCIENTIFIC, _MAX_SCIENTIFIC = 1e6, 1e-5
_MIN_OBJECT_WIDTH = 9  # of the object's name in a shortened label
_MAX_DIGITS = 7  # one fewer than single precision has
_CUT_FROM = 1e-3  # numbers from this size on have four digits or more within the decimals
_TWO_DIGITS = 3.55  # an error has two digits if its leading ones are below, by the Particle Data Group


class Format(NamedTuple):
    """Number format of a row: the last decimal place and a common power of ten."""

    place: int  # of the last digit, counted to the right of the decimal point
    exponent: int  # 0 for plain decimals

    @classmethod
    def of(cls, value: float, error: float | None, *, digits: int | None = None) -> Format:
        """Return the format of a value with an error; four significant digits without one.

        The error has ``digits`` significant digits, by default by the rounding of the Particle Data Group: two if
        the leading ones are below 355, else one, so that rounding changes the error by at most a sixth. Where it
        is so small that the value would have all its digits, both are cut, and the error is rounded up.
        """
        error = error if error is not None and math.isfinite(error) else 0.0
        size = max(abs(value) if math.isfinite(value) else 0.0, error)
        if size == 0:
            return cls(0, 0)
        place = _last_place(error, digits) if error else 3 - _exponent(size)
        place = min(place, _MAX_DIGITS - 1 - _exponent(size))
        if place + _exponent(size) + 1 == _MAX_DIGITS and _CUT_FROM <= size < _MIN_SCIENTIFIC:
            place = min(place, _MAX_DECIMALS)
        plain = place <= _MAX_DECIMALS and _MAX_SCIENTIFIC <= size < _MIN_SCIENTIFIC
        return cls(place, 0 if plain else _exponent(size))

    def at_most(self, digits: int, size: float) -> Format:
        """Return the format limited to ``digits`` significant digits for numbers of this size."""
        if size == 0 or not math.isfinite(size):
            return self
        return self._replace(place=min(self.place, digits - 1 - _exponent(size)))

    def write(self, number: float) -> str:
        """Format a number; zero is ``'0'``, without a sign."""
        if number == 0 or not math.isfinite(number):
            return minus(f"{number + 0.0:g}")
        decimals = self.place + self.exponent
        scaled = round(number / 10.0**self.exponent, decimals) + 0.0  # + 0.0 turns −0.0 into 0.0
        if self.exponent and scaled == 0:
            return "0"  # far below what it is written beside: no digits, and no power of ten of zero
        text = f"{scaled:.{max(decimals, 0)}f}"
        return minus(f"{text}e{self.exponent}" if self.exponent else text)

    def write_error(self, error: float) -> str:
        """Format an error; one whose digits are cut is rounded up, so that it is never written as 0."""
        units = error * 10.0**self.place
        if 0 < units < _TWO_DIGITS:
            error = max(1, math.ceil(round(units, 6))) / 10.0**self.place
        return self.write(error)

    def write_signed(self, number: float) -> str:
        """Format a number with its sign, except if it rounds to zero."""
        text = self.write(number)
        positive = number > 0 and re.search("[1-9]", text.partition("e")[0])
        return f"+{text}" if positive else text


def minus(text: str) -> str:
    """Write hyphens of a number as minus signs, as figures do; zero has no sign."""
    return re.sub(r"^-(?=[0.]+$)", "", text).replace("-", "−")


def rounded(number: float, digits: int = 3) -> str:
    """Return a number with at most so many significant digits: ``'0.62'``, ``'3160'``, ``'1.2e−7'``.

    Example
    -------
    >>> rounded(170.4, 2), rounded(-1.25e-7), rounded(2.0)
    ('170', '−1.25e−7', '2')
    """
    if number == 0 or not math.isfinite(number):
        return minus(f"{number + 0.0:g}")
    style = Format.of(number, None).at_most(digits, abs(number))
    text, e, exponent = style.write(number).partition("e")
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text}{e}{exponent}"


def signed_roughly(number: float) -> str:
    """Return a number that is known roughly, with its sign: ``'+1.4'``, ``'−0.32'``, ``'0'``."""
    text = rounded(number, 2)
    return f"+{text}" if number > 0 else text


def rounded_up(number: float, digits: int) -> str:
    """Return a positive number, such as an upper limit, rounded up to a number of significant ``digits``.

    Example
    -------
    >>> rounded_up(101.7, 2), rounded_up(6.01, 2), rounded_up(6.0, 2)
    ('110', '6.1', '6')
    """
    if number <= 0 or not math.isfinite(number):
        return rounded(number, digits)
    exact = Decimal(f"{number:.12g}")  # 0.07 in percent is 7, not 7.000000000000001
    unit = Decimal(1).scaleb(exact.adjusted() - digits + 1)
    return rounded(float(exact.quantize(unit, ROUND_CEILING)), digits)


def plain_number(number: float, unit: str) -> str:
    """Return a number without an error: of three digits, or of one decimal if it is a percentage.

    Example
    -------
    >>> plain_number(0.0437, "%"), plain_number(33.333, "%"), plain_number(100.0, "%"), plain_number(0.0437, "lx")
    ('0.0', '33.3', '100', '0.0437')
    """
    if unit != "%" or not math.isfinite(number):
        return rounded(number)
    return minus(f"{number + 0.0:g}" if number == round(number) else f"{number:.1f}")


def with_error(value: float, error: float | None, *, digits: int | None = None) -> tuple[str, str]:
    """Format a value and its error to the same decimal place, ``('0.0978', '0.0008')``.

    The error is an empty string for None. ``digits`` as for ``Format.of``.
    """
    style = Format.of(value, error, digits=digits)
    return style.write(value), "" if error is None else style.write_error(error)


def format_with_error(value: float, error: float | None, *, digits: int | None = None) -> str:
    """Return ``'0.0978 ± 0.0008'``; the value alone if the error is None or 0."""
    return " ± ".join(filter(None, with_error(value, error or None, digits=digits)))


def signed_with_error(value: float, error: float | None) -> str:
    """Return ``'+0.0978 ± 0.0008'``."""
    style = Format.of(value, error)
    return " ± ".join([style.write_signed(value), *([style.write_error(error)] if error else [])])


def align_with_errors(numbers: Sequence[tuple[float, float | None]], *, signed: bool = False) -> list[str]:
    """Return ``'0.0978 ± 0.0008'`` for each value and error, with the decimal points of both aligned.

    If ``signed``, positive values have a sign, too.
    """
    written = [with_error(value, error) for value, error in numbers]
    if signed:
        written = [
            (Format.of(value, error).write_signed(value), written_error)
            for (value, error), (_, written_error) in zip(numbers, written, strict=True)
        ]
    columns = zip(*written, strict=True) if written else ((), ())
    pairs = zip(*map(align_decimals, columns), strict=True)
    return [f"{value} ± {error}" if error.strip() else value for value, error in pairs]


def align_decimals(numbers: Sequence[str]) -> list[str]:
    """Pad numbers so that their decimal points are aligned."""
    heads = [re.split(r"[.e]", number, maxsplit=1)[0] for number in numbers]
    tails = [number[len(head) :] for number, head in zip(numbers, heads, strict=True)]
    left, right = max(map(len, heads), default=0), max(map(len, tails), default=0)
    return [head.rjust(left) + tail.ljust(right) for head, tail in zip(heads, tails, strict=True)]


def shorten(names: Sequence[str], width: int) -> list[str]:
    """Shorten names to ``width`` columns, and replace unprintable characters.

    A label ``object: property`` keeps both parts; the middle of the object's name is removed first. Of other names
    whole words are removed where that leaves enough. If two different names would become equal, they are cut
    elsewhere.

    Example
    -------
    >>> shorten(["mat-Wall White painted.001: diffuse reflectance", "lamp: radiance"], 36)
    ['mat-Wal…ted.001: diffuse reflectance', 'lamp: radiance']
    >>> shorten(["smoothed cosine distance of embeddings"], 36)
    ['smoothed cosine … of embeddings']
    >>> shorten(["diffuser (luminaire_left, luminaire_right and 2 more)"], 36)
    ['diffuser (luminaire_le…t and 2 more)']
    """
    names = ["".join(c if c.isprintable() else "�" for c in name) for name in names]
    middle = max(width - 1, 0) // 2
    shortened = [_cut_label(name, width, 0) for name in names]
    # Move the cut away from the middle of the object's name, then cut the whole label.
    shifts = sorted(range(-middle, middle + 1), key=abs)
    cuts = [partial(_cut_label, width=width, shift=shift) for shift in shifts]
    cuts += [partial(cut, width=width, tail=middle + shift) for shift in shifts]
    for cut_elsewhere in cuts:
        ambiguous = _ambiguous(names, shortened)
        if not ambiguous:
            return shortened
        shortened = [
            cut_elsewhere(name) if short in ambiguous else short
            for name, short in zip(names, shortened, strict=True)
        ]
    # They differ only in the middle, farther from both ends than the width.
    for ambiguous_name in _ambiguous(names, shortened):
        alike = [index for index, short in enumerate(shortened) if short == ambiguous_name]
        letters = enumerate(zip_longest(*(names[index] for index in alike)))
        start = next(place for place, ones in letters if len(set(ones)) > 1)
        for index in alike:
            shortened[index] = _cut_around(names[index], start, width)
    return shortened


def _ambiguous(names: Sequence[str], shortened: Sequence[str]) -> set[str]:
    """Return the shortened names that stand for several different names."""
    originals: dict[str, set[str]] = {}
    for name, short in zip(names, shortened, strict=True):
        originals.setdefault(short, set()).add(name)
    return {short for short, candidates in originals.items() if len(candidates) > 1}


def _cut_label(label: str, width: int, shift: int) -> str:
    """Cut a label to a width: the object's name, ``shift`` columns off its middle, and if needed the property."""
    if columns(label) <= width:
        return label
    name, separator, suffix = label.rpartition(": ")
    if separator:
        available = width - len(separator) - min(columns(name), _MIN_OBJECT_WIDTH, width // 2)
        suffix = separator + cut(suffix, available, available // 2) if available > 0 else ""
    else:
        name, suffix = label, ""
    name_width = width - columns(suffix)
    if shift == 0:
        short = _cut_in_parentheses(name, name_width) or ("" if suffix else _cut_at_words(label, width))
        if short:
            return short + suffix
    tail = min(max((name_width - 1) // 2 + shift, 0), max(name_width - 1, 0))
    return cut(name, name_width, tail) + suffix


def _cut_in_parentheses(name: str, width: int) -> str:
    """Cut ``material (its shapes)`` so that both parentheses remain; return an empty string if it has none."""
    match = re.fullmatch(r"(.+?) \((.+)\)", name)
    if match is None or width < 2 * _MIN_OBJECT_WIDTH:
        return ""
    available = width - len(" ()")
    outer, inner = match.groups()
    outer = _cut_name(outer, max(available // 2, available - columns(inner)))
    return f"{outer} ({_cut_name(inner, available - columns(outer))})"


def _cut_name(name: str, width: int) -> str:
    if columns(name) <= width:
        return name
    return _cut_at_words(name, width) or cut(name, width, (width - 1) // 2)


def _cut_at_words(name: str, width: int) -> str:
    """Replace the middle words by an ellipsis; return an empty string if half the width is lost."""
    words, head, tail = name.split(" "), "", ""
    while words:
        longer_head, longer_tail = f"{head} {words[0]}".strip(), f"{words[-1]} {tail}".strip()
        if columns(longer_head) <= columns(longer_tail) and columns(f"{longer_head} … {tail}") <= width:
            head = longer_head
            del words[0]
        elif columns(f"{head} … {longer_tail}") <= width:
            tail = longer_tail
            del words[-1]
        else:
            break
    short = f"{head} … {tail}"
    return short if head and tail and 2 * columns(short) >= width else ""


def cut(name: str, width: int, tail: int) -> str:
    """Replace what precedes the last ``tail`` columns by an ellipsis, so that at most ``width`` columns remain."""
    if columns(name) <= width:
        return name
    end = _prefix(name[::-1], min(tail, width - 1))[::-1]
    return f"{_prefix(name, width - 1 - tail)}…{end}" if width > 0 else ""


def _cut_around(name: str, start: int, width: int) -> str:
    """Cut the middle and the end of a name, so that what follows ``start`` remains."""
    head = _prefix(name, width // 3)
    return cut(f"{head}…{name[start:]}", width, 0)


def _prefix(text: str, width: int) -> str:
    """Return the longest prefix of at most ``width`` columns."""
    total = 0
    for index, character in enumerate(text):
        total += columns(character)
        if total > width:
            return text[:index]
    return text


def columns(text: str) -> int:
    """Return the width of a text in a terminal: 2 for wide (East Asian) and 0 for combining characters."""
    if text.isascii():
        return len(text)
    return sum(
        0 if unicodedata.combining(c) else 2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text
    )


def pad(text: str, width: int, *, right: bool = False) -> str:
    """Add spaces up to a width of ``width`` columns, before the text to align it ``right``."""
    spaces = " " * (width - columns(text))
    return spaces + text if right else text + spaces


def _exponent(number: float) -> int:
    """Return the power of ten of a number after rounding to four digits: 0 for 0.99999."""
    return int(f"{number:.3e}".partition("e")[2])


def _last_place(error: float, digits: int | None) -> int:
    exponent = _exponent(error)
    if digits is None:
        digits = 2 if error < _TWO_DIGITS * 10.0**exponent else 1
    return digits - 1 - exponent
