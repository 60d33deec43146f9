"""Papers whose published results `koopmpc reproduce` computes anew."""
