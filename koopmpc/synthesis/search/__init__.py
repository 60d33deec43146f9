"""The search for a model: data, candidates, folds, trials, long records, and the leaderboard."""
