"""Refusing parameters that no instrument can have."""

from depthreg.errors import InputError


def require_between(sensor: object, **limits: tuple[float, float]) -> None:
    """Check a sensor's fields, as `require_between(self, drop_share=(0, 1))`.

    Raises:
        InputError: A field isn't a number, or lies outside its limits (which are allowed themselves).
    """
    for name, (low, high) in limits.items():
        value = getattr(sensor, name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise InputError(f"sensor.{name}={value}: {type(sensor).__name__} expects a number from {low} to {high}")
