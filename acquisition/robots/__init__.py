"""Drivers of real robot arms, one file each; vendor packages are imported where they are used."""
