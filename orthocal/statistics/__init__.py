"""Of arrays: noise, chance, what readings say of parameters. Knows no fit."""
