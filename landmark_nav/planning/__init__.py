"""Planning of the positions of panoramas by predicted localization errors."""
