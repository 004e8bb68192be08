"""A camera's GenICam features by name, whichever library reaches them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TypeVar

from dataset.errors import DeviceError

Value = TypeVar("Value", bound=str | int | float | bool)


class Features(ABC):
    """The features of one camera. Every method raises DeviceError when the camera refuses or is silent."""

    def __init__(self, camera: str) -> None:
        """`camera` is what messages call it, such as "the camera at 192.168.10.20"."""
        self.camera = camera

    @abstractmethod
    def has(self, feature: str) -> bool:
        """Whether the camera has it, and it can be used now."""

    @abstractmethod
    def get(self, feature: str, kind: type[Value]) -> Value:
        """Its value: str for text and choices, int, float or bool."""

    @abstractmethod
    def set(self, feature: str, value: str | float | bool) -> None:
        """Sets it."""

    @abstractmethod
    def bounds(self, feature: str) -> tuple[float, float]:
        """The lowest and the highest value that a number can take now."""

    @abstractmethod
    def choices(self, feature: str) -> tuple[str, ...]:
        """What a choice can be set to."""

    @abstractmethod
    def execute(self, command: str) -> None:
        """Executes a command."""

    def read(self, feature: str, kind: type[Value], otherwise: Value) -> Value:
        """Its value, or `otherwise` where the camera has no such feature."""
        return self.get(feature, kind) if self.has(feature) else otherwise

    def require(self, feature: str, value: str | int | bool, remedy: str) -> None:
        """Sets it and reads it back.

        Raises DeviceError, ending with the remedy, when it stays different.
        """
        kind = type(value)
        if self.get(feature, kind) == value:
            return
        reason = ""
        try:
            self.set(feature, value)
        except DeviceError as error:
            reason = f" ({error})"
        found = self.get(feature, kind)
        if found != value:
            raise DeviceError(f"{self.camera} keeps {feature} at {found}, not {value}{reason}; {remedy}")

    def require_near(self, feature: str, value: float, tolerance: float, name: str) -> None:
        """Sets a number and reads it back; cameras round to their own steps.

        Args:
            feature: to set.
            value: within its bounds.
            tolerance: how far the camera may round it.
            name: of the setting in the rig file.

        Raises DeviceError, naming the bounds, when the value is out of them or stays different.
        """
        lowest, highest = self.bounds(feature)
        if not lowest <= value <= highest:
            raise DeviceError(
                f"{self.camera} cannot take {name} = {value:g}: its {feature} goes from {lowest:g} to "
                f"{highest:g}; correct [camera] in the rig file"
            )
        self.set(feature, float(value))
        found = self.get(feature, float)
        if abs(found - value) > tolerance:
            raise DeviceError(
                f"{self.camera} was set to {name} = {value:g} and reads back {found:g}: something else "
                f"controls its {feature}; check its power-on settings in the maker's software, then try again"
            )
