"""The type checker behind the shape-checking hook: beartype, which accepts an int in place of a float."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
