"""
Propagation, correction and weighing of the hypotheses by one fix, as one compiled call.

References
----------
.. [1] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
       distribution", Journal of the American Statistical Association 84, 1989.
"""

from __future__ import annotations

import numpy as np

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.state import COVARIANCE, N_ERROR, VELOCITY
from hybrid_ins.core.noise.hypotheses import COUNT, ON_NOISE, SLOW_WALK
from hybrid_ins.core.noise.multiple_model_step import advance, mean_system
from hybrid_ins.core.noise.weights import FAMILIES, add_likelihood, average, fade, weigh
from hybrid_ins.core.update.kalman import covariances_at_full_weight

TAIL_DOF = 6.0  # degrees of freedom of an innovation's t distribution, [1]_

# What is known besides the hypotheses' estimates, as one flat vector.
FACTORS = slice(0, 12)  # in force, see `weights.average`
LOWEST = slice(12, 20)  # of those that move the state, since it was last corrected
CLAIMED_STDS = slice(20, 22)  # m, of the last position, horizontally and of the height
LAST_VELOCITY, LAST_C = slice(22, 25), slice(25, 34)  # n, and C_nb, after the last correction
PENDING_G = slice(34, 34 + N_ERROR * N_ERROR)  # see `multiple_model_step.advance`
LOG_LIKELIHOOD = slice(PENDING_G.stop, PENDING_G.stop + COUNT)  # of each, within its family
OF_FAMILY = slice(LOG_LIKELIHOOD.stop, LOG_LIKELIHOOD.stop + FAMILIES)  # of each family
WEIGHTS = slice(OF_FAMILY.stop, OF_FAMILY.stop + COUNT)


@kernel(fastmath={"contract"})
def update_hypotheses(  # type: ignore[no-untyped-def]
    hypotheses,
    before,
    after,
    values,
    T,
    nav,
    psd,
    H,
    S,
    fix_factor,
    stamp_variance,
    of_stamp,
    stamp_stds,
    roots,
    roots_in_force,
    slow_growth,
    claimed_stds,
    dx,
    z_x,
    H_x,
    x,
    G_x,
    teaches,
):
    """
    Propagate and correct the hypotheses, and weigh them.

    Parameters
    ----------
    hypotheses : ndarray, shape (17, WIDTH)
        `HYPOTHESES`, the last one repeated.
    before, after : ndarray, shape (N_ROWS, WIDTH)
        Their estimates, see `advance`; ``after`` is written.
    values : ndarray, shape (WEIGHTS.stop,)
        What is known besides; overwritten.
    T : float
        Time since the last correction [s].
    nav, psd, H, S, fix_factor, stamp_variance, of_stamp, slow_growth, claimed_stds, dx
        See `NoiseMultipleModelBank.update`.
    stamp_stds, roots, roots_in_force : ndarray, shape (WIDTH,), (m, WIDTH), (m,)
        Standard deviations of the fix's stamp [s]; roots of the factors on rows and columns of R.
    z_x, H_x, x, G_x : ndarray
        `iterated_update.linearisation` of the correction.
    teaches : bool
        Otherwise likelihoods are not changed.

    Returns
    -------
    bool
        A factor has risen by `CORRECTION_RATIO`.
    """
    m, G = len(S), values[PENDING_G].reshape(N_ERROR, N_ERROR)
    last_C = values[LAST_C].reshape(3, 3)
    F, C_mean = mean_system(nav, values[LAST_VELOCITY], last_C, T)
    _, R = covariances_at_full_weight(nav[COVARIANCE], H, S, 1.0)
    for a in range(m):
        for b in range(m):
            R[a, b] -= stamp_variance * of_stamp[a, b]
            R[a, b] /= fix_factor * roots_in_force[a] * roots_in_force[b]
    if claimed_stds[0] > 0.0:
        values[CLAIMED_STDS] = claimed_stds
    log_likelihood = np.zeros(before.shape[1])
    factors, walk = hypotheses[ON_NOISE], hypotheses[SLOW_WALK]
    advance(
        before,
        after,
        G,
        F,
        T,
        C_mean,
        psd,
        factors,
        walk,
        slow_growth,
        stamp_stds,
        z_x,
        H_x,
        R,
        roots,
        of_stamp,
        x,
        TAIL_DOF,
        log_likelihood,
    )
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            G[i, j] = G_x[i, j]
    for i in range(3):
        values[LAST_VELOCITY][i] = nav[VELOCITY][i] + dx[3 + i]
    fade(T, values[LOG_LIKELIHOOD], values[OF_FAMILY])
    if not teaches:
        return False
    claimed = values[CLAIMED_STDS][0], values[CLAIMED_STDS][1]
    add_likelihood(log_likelihood, claimed, values[LOG_LIKELIHOOD], values[OF_FAMILY])
    weigh(values[LOG_LIKELIHOOD], values[OF_FAMILY], claimed, values[WEIGHTS])
    return average(values[WEIGHTS], values[FACTORS], values[LOWEST])
