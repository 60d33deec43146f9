from tests.example_plants import brute_force as brute_force
from tests.example_plants import one_step_pairs as one_step_pairs
from tests.example_plants import random_episodes as random_episodes
