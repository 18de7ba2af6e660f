"""Trials of a plan at the bench, as an operator has them handed out and scores them on the Eval tab."""

from tests.processes import eventually

_NEXT = "document.querySelector('[data-next]:not([aria-disabled=true])')?.click()"  # it may be drawn anew meanwhile


def shown(operator):
    """The code of the trial that is on the page."""
    return operator.page.locator(".plan-code").inner_text()


def handed(operator):
    """The code of the next trial, which is handed out and set up; pressed again where a score was on its way still."""
    code = operator.page.locator(".plan-code")

    def there():
        if not code.is_visible():
            operator.page.evaluate(_NEXT)
            operator.page.wait_for_timeout(1000)
        return code.is_visible()

    eventually(there, "the next trial is handed out")
    operator.reaches("READY")
    operator.page.locator("#steps[data-set-up=yes]").wait_for()
    return shown(operator)


def stopped(operator):
    """The run is stopped, and waits to be scored."""
    operator.page.locator("[data-command=stop][data-trial]:visible").click()
    operator.page.locator("#score").wait_for()


def saved(operator, ticks, failure=()):
    """What is ticked is saved, with what is pressed of its failure."""
    operator.page.locator("#score").wait_for()
    for key in ticks:
        box = operator.page.locator("#score input[name=milestone]").nth(key - 1)
        if not box.is_checked():
            box.check()
    if failure:  # of a success it is not asked
        for state in ("hidden", "visible"):
            operator.page.keyboard.press("4")
            operator.page.locator("#why").wait_for(state=state)
    for key in failure:
        operator.page.keyboard.press(key)
    operator.page.locator("button[form=score]").click()
    operator.page.locator("[data-next]").wait_for()
