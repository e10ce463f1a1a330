"""One parameter: its type, default, bounds and meaning, and how a value is checked against them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from hybrid_ins import yaml_reader
from hybrid_ins.errors import InputError
from hybrid_ins.resources import shortened

Value = bool | int | float | str | list[float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """
    One parameter: its default fixes its type.

    Attributes
    ----------
    name, default, text : str, Value, str
        ``text`` is the description that ``ros2 param describe`` shows.
    unit : str
        Empty for plain numbers and texts.
    low, high : float
        Inclusive bounds of a number, or of each element of a list.
    or_zero : bool
        Zero is allowed although it is below ``low``.
    choices : tuple of str
        Allowed texts; empty: any.
    experiment_choices : tuple of str
        Those of the choices that are for comparisons, not for a robot.
    lengths : tuple of int
        Allowed lengths of a list; where 1 is, a number is accepted as well.
    longest : int
        Largest length of a text.
    runtime : bool
        It may be changed while the node runs.
    experiment : bool
        It is for comparisons, not for a robot.
    """

    name: str
    default: Value
    text: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    or_zero: bool = False
    choices: tuple[str, ...] = ()
    experiment_choices: tuple[str, ...] = ()
    lengths: tuple[int, ...] = (3,)
    longest: int = 255
    runtime: bool = False
    experiment: bool = False

    def check(self, value: object) -> Value:
        """
        Return ``value`` as this parameter's type.

        A text is read as YAML where something else is wanted: ``ros2 param set`` and ``ros2 param
        load`` send numbers such as 1e-6 as texts.

        Raises
        ------
        InputError
            The value has another type, or is outside the bounds; the text names all three.
        """
        if isinstance(self.default, str):
            return self._checked_text(value)
        if isinstance(value, str):
            try:
                value = yaml_reader.parse(value)
            except ValueError:
                raise self._refusal(value, self._wanted()) from None
        if isinstance(self.default, bool):
            if isinstance(value, bool):
                return value
            raise self._refusal(value, self._wanted())
        if isinstance(self.default, list):
            if 1 in self.lengths and isinstance(value, int | float):
                value = [value]
            if not isinstance(value, list | tuple) or len(value) not in self.lengths:
                raise self._refusal(value, self._wanted())
            return [self._checked_number(v, value) for v in value]
        if isinstance(self.default, int):
            if isinstance(value, bool) or not isinstance(value, int):
                raise self._refusal(value, self._wanted())
            return int(self._checked_number(value, value))
        return self._checked_number(value, value)

    def bounds(self) -> str:
        """Return the range and the unit of a number, or of each element of a list."""
        if not (math.isfinite(self.low) and math.isfinite(self.high)):
            return self.unit
        zero = "0 or " if self.or_zero else ""
        return f"{zero}{_exact(self.low)} … {_exact(self.high)} {self.unit}".rstrip()

    def _wanted(self) -> str:
        if isinstance(self.default, bool):
            return "true or false"
        if isinstance(self.default, list):
            return f"a list of {' or '.join(map(str, self.lengths))} numbers"
        return "a whole number" if isinstance(self.default, int) else "a number"

    def _checked_text(self, value: object) -> str:
        if value is None:  # what YAML reads where nothing is given, as behind "-p noise.model:="
            value = ""
        if not isinstance(value, str):
            raise self._refusal(value, "a text")
        if self.choices and value not in self.choices:
            raise self._refusal(value, "one of " + ", ".join(self.choices))
        if len(value) > self.longest or "\0" in value:
            raise self._refusal(value, f"a text of at most {self.longest} characters")
        return value

    def _checked_number(self, value: object, whole: object) -> float:
        if isinstance(value, str):
            try:
                value = yaml_reader.parse(value)
            except ValueError:
                raise self._refusal(whole, self._wanted()) from None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._refusal(whole, self._wanted())
        if not (self.low <= value <= self.high or (self.or_zero and value == 0)):
            raise self._refusal(whole, f"in the range {self.bounds()}")
        return float(value)

    def _refusal(self, value: object, wanted: str) -> InputError:
        shown = shortened(repr(value), 60)
        return InputError(f"parameter {self.name}: {shown} is not {wanted} ({self.text})")


def _exact(bound: float) -> str:
    """Return a bound as short as it can be without another value: 0.999… is not 1."""
    short = f"{bound:g}"
    return short if float(short) == bound else repr(bound)
