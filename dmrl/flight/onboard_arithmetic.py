"""Functions of `onboard_pilot` and ``pilot.c`` in +, -, * and /, the same bits on every machine."""


def turn_of(angle_rad: float) -> tuple[float, float]:
    """Return cosine and sine of a small angle, from the tangent of its half."""
    half = angle_rad / 2.0
    scale = 1.0 / (1.0 + half * half)
    return (1.0 - half * half) * scale, 2.0 * half * scale


def root(value: float) -> float:
    """Return the square root, by Newton's method."""
    if value <= 0.0:
        return 0.0
    guess = max(value, 1.0)
    for _ in range(40):
        guess = 0.5 * (guess + value / guess)
    return guess


def angle_of(x: float, y: float) -> float:
    """Return the direction of a point, radians to the left of x (Abramowitz and Stegun 4.4.49)."""
    wide, high = abs(x), abs(y)
    if wide + high == 0.0:
        return 0.0
    t = min(wide, high) / max(wide, high)
    q = t * t
    a = 0.9998660 + q * (-0.3302995 + q * (0.1801410 + q * (-0.0851330 + q * 0.0208351)))
    a *= t
    if high > wide:
        a = 1.5707963267948966 - a
    if x < 0.0:
        a = 3.141592653589793 - a
    return a if y >= 0.0 else -a
