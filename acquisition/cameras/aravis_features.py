"""GenICam features through Aravis."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from acquisition.cameras.features import Features, Value
from dataset.errors import DeviceError

_KINDS: dict[type, str] = {str: "string", int: "integer", float: "float", bool: "boolean"}


class AravisFeatures(Features):
    """The features of the Aravis.Device that is attached."""

    def __init__(self, camera: str, error: type[Exception]) -> None:
        """`error` is what Aravis' calls raise."""
        super().__init__(camera)
        self._error = error
        self._device: Any = None

    def attach(self, device: Any) -> None:
        """From now on speaks of this device."""
        self._device = device

    def detach(self) -> Any:
        """Gives the device back: whoever still holds these features, such as an error, does not hold it."""
        device, self._device = self._device, None
        return device

    def has(self, feature: str) -> bool:
        """See `Features.has`."""
        with self._explain(feature, "look at"):
            return bool(self._device.is_feature_available(feature))

    def get(self, feature: str, kind: type[Value]) -> Value:
        """See `Features.get`."""
        with self._explain(feature, "read"):
            return kind(getattr(self._device, f"get_{_KINDS[kind]}_feature_value")(feature))

    def set(self, feature: str, value: str | float | bool) -> None:
        """See `Features.set`."""
        with self._explain(feature, f"take {value} as"):
            getattr(self._device, f"set_{_KINDS[type(value)]}_feature_value")(feature, value)

    def bounds(self, feature: str) -> tuple[float, float]:
        """See `Features.bounds`."""
        with self._explain(feature, "tell the bounds of"):
            if self._is_float(feature):
                lowest, highest = self._device.get_float_feature_bounds(feature)
            else:
                lowest, highest = self._device.get_integer_feature_bounds(feature)
            return lowest, highest

    def choices(self, feature: str) -> tuple[str, ...]:
        """See `Features.choices`."""
        with self._explain(feature, "list the choices of"):
            return tuple(self._device.dup_available_enumeration_feature_values_as_strings(feature))

    def execute(self, command: str) -> None:
        """See `Features.execute`."""
        with self._explain(command, "execute"):
            self._device.execute_command(command)

    def _is_float(self, feature: str) -> bool:
        with contextlib.suppress(self._error):
            self._device.get_float_feature_value(feature)
            return True
        return False

    @contextlib.contextmanager
    def _explain(self, feature: str, verb: str) -> Iterator[None]:
        try:
            yield
        except self._error as error:
            reason = getattr(error, "message", str(error))
            raise DeviceError(
                f"{self.camera} did not {verb} {feature} ({reason}); check the cable and try again"
            ) from error
