"""Small systems with and without a Constant, and a Kalman filter as the textbook has it."""

import numpy as np

from tests import example_plants as plants


def linear(A, B, constant=None, E=None, dt=0.1):
    """x⁺ = A x + B u (+ E w + c), its names with units."""
    return plants.linear(A, B, constant, E, dt, units=True)


def stable(rng, nx, nu, radius=0.8):
    """A random (A, B) whose modes all die out."""
    return plants.random_pair(rng, nx, nu, radius)


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
