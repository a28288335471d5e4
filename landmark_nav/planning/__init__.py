"""Where to take panoramas: what they would be worth, predicted, and the best places for them."""
