"""How light limits the growth of microalgae."""

from __future__ import annotations

from cirl_marl.network.rowsum import Floats


def light_response(light: Floats, *, half_saturation: float, inhibition: float) -> Floats:
    """Return f(I) = I/(I + K_sI + I²/K_iI), in [0, 1], shape as I.

    With K_sI > 0 (Haldane) f(0) = 0 and f is greatest at I* = √(K_sI·K_iI). With the published K_sI = 0 the expression
    is 0/0 in darkness; it is evaluated as its limit 1/(1 + I/K_iI), which falls with I: less light, more growth.

    Args:
        light: I ≥ 0, µmol/(m² s).
        half_saturation: K_sI, µmol/(m² s).
        inhibition: K_iI, µmol/(m² s).
    """
    response: Floats
    if half_saturation == 0.0:
        response = 1.0 / (1.0 + light / inhibition)
    else:
        response = light / (light + half_saturation + light**2 / inhibition)
    return response
