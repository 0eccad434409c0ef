"""Of the plan of a run, what a test looks at: other tests run the whole plan of the same recording or of others."""

from dataclasses import replace


def needed(plan, *names):
    """A plan of the steps of these names, and of those that they are made from."""
    wanted = {step.key for step in plan.steps.values() if step.name in names}
    for step in reversed(plan.steps.values()):
        if step.key in wanted:
            wanted.update(step.needs)
    return replace(plan, steps={key: step for key, step in plan.steps.items() if key in wanted})
