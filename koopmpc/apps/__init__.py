"""What runs whole tasks: the papers that `koopmpc reproduce` reproduces."""
