"""The smallest form of a program that is sure to make the same decisions from every start that it was trained on."""

from __future__ import annotations

from progpolicy_envs import find_domain
from sb3_progpolicy.analysis.rollout import make_batch
from sb3_progpolicy.analysis.simplify import Simplification, simplify
from sb3_progpolicy.programs.syntax import ProgramData
from sb3_progpolicy.surroundings import surroundings

#: Starts of all training variations, at most: these few are gone through before a program is shown.
MAX_STARTS = 1000
SECONDS = 10.0


def lossless(program: ProgramData, env_id: str | None) -> Simplification | None:
    """Return a program's simplification if it loses nothing on the training variations and is proven to be minimal.

    :param program: any
    :param env_id: of its environment; ``None`` if it is not known
    :return: ``None`` where starts cannot be counted or are many, or no such simplification is found in time
    """
    domain = find_domain(env_id)
    if domain is None or domain.simulation or program.action.kind != "discrete" or "simplified" in program.metadata:
        return None
    try:
        batch, own = make_batch(program, domain.id, 1), surroundings(program, domain.id).variation
        if sum(batch.count_starts({**own, **variation}) for variation in domain.trained) > MAX_STARTS:
            return None
        found = simplify(program, domain.id, n_starts=MAX_STARTS, time_limit=SECONDS)
    except (ValueError, ModuleNotFoundError):  # it does not fit, its starts cannot be counted, or SciPy is missing
        return None
    minimal = found.terms_lower_bound == found.terms_after < found.terms_before
    return found if found.exhaustive and minimal and not found.notes else None
