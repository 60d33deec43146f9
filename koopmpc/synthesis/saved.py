"""load_controller: a controller from the file that `save` of a controller or of a Design wrote."""

from pathlib import Path

from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from koopmpc.control.saved import SavedController
from koopmpc.errors import KoopmpcError, LogError
from koopmpc.predict.base import load_value
from koopmpc.synthesis.designed import SavedDesign

AnyMPC = KoopmanMPC | BilinearMPC | NonlinearMPC
_KINDS: dict[str, type[AnyMPC]] = {kind.__name__: kind for kind in (KoopmanMPC, BilinearMPC, NonlinearMPC)}


def load_controller(path: str | Path) -> AnyMPC:
    """Return the controller that `save` of a controller or of a Design wrote, as after `reset`.

    The file holds numbers and names only; reading it runs no code of it.

    Raises
    ------
    LogError
        The file is missing, cut or damaged, holds something else, or is of another version.
    """
    return made(saved_controller(path), path)


def saved_controller(path: str | Path) -> SavedController | SavedDesign:
    """Return what the file holds: a controller, or a design."""
    return load_value(path, SavedController, SavedDesign)


def made(saved: SavedController | SavedDesign, path: str | Path) -> AnyMPC:
    """Return the controller; raise LogError where its parts do not go together."""
    one = saved.controller if isinstance(saved, SavedDesign) else saved
    try:
        return _KINDS[one.name](
            one.model,  # pyright: ignore[reportArgumentType]  # a KoopmanMPC refuses what is not linear
            one.cost,
            one.limits,
            one.horizon,
            estimator=one.estimator,  # pyright: ignore[reportArgumentType]  # it starts an observer, or is refused
            latency=one.latency,
            moves=one.moves,
            time_limit=one.time_limit,
            monitor=one.monitor,
            **one.options,
        )
    except (KoopmpcError, TypeError) as error:
        raise LogError(f"{path} holds a controller whose parts do not go together: {error}") from error
