"""Small systems with and without a Constant, and a Kalman filter as the textbook has it."""

import numpy as np
import scipy.linalg

import koopmpc as km


def linear(A, B, constant=None, E=None, dt=0.1):
    """x⁺ = A x + B u (+ E w + c) as a predictor on State() (+ Constant())."""
    nx, nu = np.shape(B)
    states, inputs = tuple(f"x{i} [m]" for i in range(nx)), tuple(f"u{i} [N]" for i in range(nu))
    nw = 0 if E is None else np.shape(E)[1]
    extra = {} if E is None else {"E": np.array(E), "disturbances": tuple(f"w{i}" for i in range(nw))}
    if constant is None:
        return km.LinearPredictor(np.array(A), np.array(B), np.eye(nx), km.State(), dt, states, inputs, **extra)
    whole = scipy.linalg.block_diag(A, 1.0)
    whole[:nx, nx] = constant
    if E is not None:
        extra["E"] = np.vstack([E, np.zeros((1, nw))])
    return km.LinearPredictor(
        whole,
        np.vstack([B, np.zeros((1, nu))]),
        np.eye(nx, nx + 1),
        km.State() + km.Constant(),
        dt,
        states,
        inputs,
        **extra,
    )


def stable(rng, nx, nu, radius=0.8):
    """A random (A, B) whose modes all die out."""
    A = rng.normal(size=(nx, nx))
    return A * radius / np.abs(np.linalg.eigvals(A)).max(), rng.normal(size=(nx, nu))


class Textbook:
    """Predict, correct, with the covariance carried along."""

    def __init__(self, F, G, f, M, Q, R, s, P):
        self.F, self.G, self.f, self.M, self.Q, self.R = F, G, f, M, Q, R
        self.s, self.P = np.array(s), np.array(P)

    def predict(self, u):
        self.s = self.F @ self.s + self.G @ u + self.f
        self.P = self.F @ self.P @ self.F.T + self.Q

    def correct(self, y):
        seen = np.isfinite(y)
        M, R = self.M[seen], self.R[np.ix_(seen, seen)]
        K = self.P @ M.T @ np.linalg.inv(M @ self.P @ M.T + R)
        self.s = self.s + K @ (y[seen] - M @ self.s)
        self.P = (np.eye(len(self.s)) - K @ M) @ self.P
        return self.s

    def settle(self):
        """The covariance before a measurement, by running the recursion until it stands."""
        P, moved, rounds = np.eye(len(self.F)), 1.0, 0
        while moved > 1e-13 and rounds < 3000:
            K = P @ self.M.T @ np.linalg.inv(self.M @ P @ self.M.T + self.R)
            later = self.F @ (P - K @ self.M @ P) @ self.F.T + self.Q
            moved, P, rounds = np.abs(later - P).max() / np.abs(P).max(), later, rounds + 1
        return P
