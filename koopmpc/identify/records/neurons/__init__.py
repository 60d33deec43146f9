"""What fits of hidden states with neurons need beside the hidden state itself."""
