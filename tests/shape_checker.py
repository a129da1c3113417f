"""The type checker behind the shape-checking hook: beartype, letting an int stand where a float may."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
