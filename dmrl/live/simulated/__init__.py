"""Simulated Crazyflies and AI-decks that send a flight over the network."""
