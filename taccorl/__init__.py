"""TacCoRL: touch for vision-language-action policies, learned from recordings and a calibrated twin."""

__version__ = "0.1.0"
