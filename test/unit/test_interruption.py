"""A signal is handled where the program checks for it, and nowhere else."""

import os
import signal

import pytest

from landmark_nav.demo.supervisor import Interruption

NUMBERS = [signal.SIGINT, signal.SIGTERM]


class Signalled:
    """A signal comes as it is taken away, where an exception would be lost."""

    def __init__(self, number):
        self.number = number

    def __del__(self):
        os.kill(os.getpid(), self.number)


def interrupted(number):
    """Be signalled in a destructor, go on, and heed it."""
    with Interruption() as interruption:
        interruption.check()
        thing = Signalled(number)
        del thing
        interruption.check()
        pytest.fail('it was not raised')


def interrupted_at_its_end(then=None):
    with Interruption():
        os.kill(os.getpid(), signal.SIGTERM)
        if then is not None:
            raise then


@pytest.mark.parametrize('number', NUMBERS)
def test_a_signal_in_a_destructor_is_not_lost(number):
    handlers = [signal.getsignal(each) for each in NUMBERS]
    with pytest.raises(KeyboardInterrupt) as raised:
        interrupted(number)
    assert raised.value.args == (number,)
    assert [signal.getsignal(each) for each in NUMBERS] == handlers


def test_a_pending_signal_is_raised_at_the_end():
    with pytest.raises(KeyboardInterrupt):
        interrupted_at_its_end()


def test_an_error_is_not_hidden_by_a_signal():
    with pytest.raises(ZeroDivisionError):
        interrupted_at_its_end(ZeroDivisionError)
