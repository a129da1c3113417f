from native.conftest import isa as isa
