"""Many runs of one method: scenes x variants x seeds, run, scored and summarised (docs/study.md)."""
