"""koopmpc: from a CasADi model or from data to a constrained controller with a lifted linear predictor."""
