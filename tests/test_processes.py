"""The diffusion processes against the paper's equations."""

import math
from itertools import pairwise

import pytest
import torch

from lerobot_hdp.processes import Corrupted, GaussianProcess, GaussianSymbolProcess, MaskedProcess

N = 100


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TestGaussianProcess:
    def test_alpha_bar_is_the_product_of_squared_cosine_alphas(self):
        process = GaussianProcess(N, "epsilon")

        def f(t):
            return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

        expected = 1.0
        assert process.alpha_bar(torch.tensor(0.0)) == 1.0
        for step in range(1, N + 1):
            expected *= 1 - min(1 - f(step / N) / f((step - 1) / N), 0.999)
            assert process.alpha_bar(torch.tensor(step / N)) == pytest.approx(expected, rel=1e-4)

    @pytest.mark.parametrize("level", [0.01, 0.3, 1.0])
    def test_corruption_has_the_mean_and_variance_of_eq_1(self, level):
        process = GaussianProcess(N, "epsilon")
        clean = torch.full((40_000, 1, 1), 0.7)
        value = process.corrupt(clean, torch.full((len(clean),), level), generator()).value
        alpha_bar = process.alpha_bar(torch.tensor(level)).item()
        assert value.mean() == pytest.approx(math.sqrt(alpha_bar) * 0.7, abs=0.02)
        assert value.var() == pytest.approx(1 - alpha_bar, rel=0.03, abs=1e-6)

    def test_reverse_step_has_the_mean_and_variance_of_eq_3(self):
        """The posterior of DDPM (Ho et al. 2020, Eq. 7, 11) for one step, with the true noise as the prediction."""
        process = GaussianProcess(N, "epsilon")
        step, clean, noise = 40, 0.3, -0.5
        level, next_level = torch.tensor(step / N), torch.tensor((step - 1) / N)
        alpha_bar, next_alpha_bar = process.alpha_bar(level).item(), process.alpha_bar(next_level).item()
        alpha = alpha_bar / next_alpha_bar
        value = math.sqrt(alpha_bar) * clean + math.sqrt(1 - alpha_bar) * noise
        expected_mean = (value - (1 - alpha) / math.sqrt(1 - alpha_bar) * noise) / math.sqrt(alpha)
        expected_variance = (1 - next_alpha_bar) / (1 - alpha_bar) * (1 - alpha)

        values, prediction = torch.full((40_000, 1, 1), value), torch.full((40_000, 1, 1), noise)
        drawn = process.reverse_step(values, prediction, level, next_level, generator())
        assert drawn.mean() == pytest.approx(expected_mean, abs=5 * math.sqrt(expected_variance / 40_000))
        assert drawn.var() == pytest.approx(expected_variance, rel=0.03)

    @pytest.mark.parametrize("prediction_type", ["epsilon", "sample", "v_prediction"])
    def test_the_training_target_leads_back_to_the_clean_sample(self, prediction_type):
        process = GaussianProcess(N, prediction_type)
        clean = torch.rand(16, 5, 3, generator=generator()) * 2 - 1
        level = torch.linspace(0.1, 0.9, 16)
        corrupted = process.corrupt(clean, level, generator())
        for i in range(16):
            row = slice(i, i + 1)
            sample = process.predicted_sample(corrupted.value[row], corrupted.target[row], level[i])
            torch.testing.assert_close(sample, clean[row], atol=1e-4, rtol=0)

    @pytest.mark.parametrize("prediction_type", ["epsilon", "sample", "v_prediction"])
    def test_what_is_predicted_outside_of_the_normalised_range_is_clipped(self, prediction_type):
        process, level = GaussianProcess(N, prediction_type), torch.tensor(0.5)
        far = torch.tensor([3.0, -3.0, 0.5]).expand(2, 4, 3)
        corrupted = process.corrupt(far, level.expand(2), generator())
        sample = process.predicted_sample(corrupted.value, corrupted.target, level)
        torch.testing.assert_close(sample, far.clamp(-1, 1), atol=1e-4, rtol=0)

    def test_ddim_is_deterministic_and_ddpm_is_not(self):
        value, prediction = torch.randn(2, 4, 3, generator=generator()), torch.zeros(2, 4, 3)
        levels = torch.tensor(0.8), torch.tensor(0.4)
        for eta, same in [(0.0, True), (1.0, False)]:
            process = GaussianProcess(N, "sample", eta=eta)
            first, second = (process.reverse_step(value, prediction, *levels, generator(seed)) for seed in (1, 2))
            assert torch.equal(first, second) == same

    def test_last_reverse_step_gives_the_predicted_sample(self):
        process = GaussianProcess(N, "sample")
        prediction = torch.rand(2, 4, 3, generator=generator())
        value = torch.randn(2, 4, 3, generator=generator())
        drawn = process.reverse_step(value, prediction, torch.tensor(1 / N), torch.tensor(0.0))
        torch.testing.assert_close(drawn, prediction)

    @pytest.mark.parametrize("num_steps", [1, 7, 100])
    def test_levels_fall_from_one_to_zero(self, num_steps):
        levels = GaussianProcess(N, "sample").levels(num_steps)
        assert len(levels) == num_steps + 1
        assert levels[0] == 1
        assert levels[-1] == 0
        assert (levels.diff() < 0).all()

    @pytest.mark.parametrize("num_steps", [0, N + 1])
    def test_there_are_no_more_levels_than_training_steps(self, num_steps):
        with pytest.raises(ValueError, match=f"a plan takes 1 to 100 network calls, got {num_steps}"):
            GaussianProcess(N, "sample").levels(num_steps)

    def test_training_levels_are_uniform_over_the_steps(self):
        torch.manual_seed(0)
        steps = (GaussianProcess(N, "sample").sample_level(100_000, torch.device("cpu")) * N).round().long()
        counts = torch.bincount(steps, minlength=N + 1)
        assert counts[0] == 0
        assert counts[1:].min() > 850
        assert counts[1:].max() < 1150


class TestGaussianSymbolProcess:
    def test_a_clean_token_is_a_vector_with_one_at_its_id_and_minus_one_elsewhere(self):
        process, tokens = GaussianSymbolProcess(3, N, "sample"), torch.tensor([[0, 2]])
        value = process.corrupt(tokens, torch.zeros(1), generator()).value
        assert value.tolist() == [[[1, -1, -1], [-1, -1, 1]]]
        assert torch.equal(process.tokens(value), tokens)


class TestMaskedProcess:
    @pytest.mark.parametrize("level", [0.1, 0.5, 1.0])
    def test_tokens_are_masked_with_the_probability_of_eq_4(self, level):
        process = MaskedProcess(vocabulary_size=5)
        clean = torch.randint(5, (2000, 20), generator=generator())
        corrupted = process.corrupt(clean, torch.full((2000,), level), generator(1))
        masked = corrupted.value == process.mask_id
        assert masked.float().mean() == pytest.approx(level, abs=0.01)
        assert torch.equal(corrupted.value[~masked], clean[~masked])

    def test_loss_is_cross_entropy_over_masked_tokens_weighted_by_one_over_k(self):
        process = MaskedProcess(vocabulary_size=3)
        clean = torch.tensor([[0, 1, 2]])
        value = torch.tensor([[0, process.mask_id, process.mask_id]])
        logits = torch.tensor([[[0.0, 1.0, 2.0], [0.5, 0.0, 1.0], [0.0, 0.0, 3.0]]])
        log_probabilities = logits.log_softmax(dim=-1)
        expected = -(log_probabilities[0, 1, 1] + log_probabilities[0, 2, 2]) / 0.4
        loss = process.loss(logits, Corrupted(value, clean, torch.tensor([0.4])))
        torch.testing.assert_close(loss, expected[None])

    def test_the_mean_loss_does_not_depend_on_the_schedule(self):
        # A denoiser that is less sure the more is masked: cross-entropy 1 + k at every masked position.
        clean, means = torch.zeros(200_000, 4, dtype=torch.int64), []
        for schedule in ("linear", "cosine"):
            process = MaskedProcess(2, schedule=schedule)
            generator = torch.Generator().manual_seed(0)
            level = process.sample_level(len(clean), clean.device, generator)
            corrupted = process.corrupt(clean, level, generator)
            logits = torch.stack([torch.zeros_like(level), torch.log(torch.expm1(1 + level))], dim=-1)
            means.append(process.loss(logits[:, None].expand(-1, 4, -1), corrupted).mean().item())
        assert means[0] == pytest.approx(4 * 1.5, rel=0.01)
        assert means[1] == pytest.approx(means[0], rel=0.01)

    def test_masked_tokens_are_revealed_with_the_probability_of_eq_6(self):
        process = MaskedProcess(vocabulary_size=4)
        value = process.prior((2000, 20), torch.device("cpu"))
        prediction = torch.tensor([0.1, 0.2, 0.3, 0.4]).log().expand(2000, 20, 4)
        level, next_level = torch.tensor(0.8), torch.tensor(0.6)
        drawn = process.reverse_step(value, prediction, level, next_level, generator())
        revealed = drawn[drawn != process.mask_id]
        # gamma = (alpha(s) - alpha(t)) / (1 - alpha(t)) with alpha(t) = 1 - t
        assert len(revealed) / value.numel() == pytest.approx((0.8 - 0.6) / 0.8, abs=0.01)
        frequencies = torch.bincount(revealed, minlength=4) / len(revealed)
        torch.testing.assert_close(frequencies, torch.tensor([0.1, 0.2, 0.3, 0.4]), atol=0.02, rtol=0)

    def test_revealed_tokens_stay(self):
        process = MaskedProcess(vocabulary_size=4)
        value = torch.tensor([[0, 3, process.mask_id]])
        drawn = process.reverse_step(value, torch.randn(1, 3, 4), torch.tensor(0.5), torch.tensor(0.1))
        assert drawn[0, :2].tolist() == [0, 3]

    def test_with_a_threshold_sure_tokens_are_revealed_and_the_surest_in_any_case(self):
        process = MaskedProcess(vocabulary_size=2, confidence_threshold=0.9)
        mask = process.mask_id
        value = torch.tensor([[mask, mask, mask, 0], [mask, mask, mask, mask]])
        probability_of_0 = torch.tensor([[1.0, 0.6, 0.95, 0.5], [0.5, 0.6, 0.5, 0.9]])
        prediction = torch.stack([probability_of_0, 1 - probability_of_0], dim=-1).log()
        draws = torch.stack(
            [
                process.reverse_step(value, prediction, torch.tensor(0.9), torch.tensor(0.8), generator(i))
                for i in range(300)
            ]
        )
        revealed = draws != mask
        assert (revealed.sum(dim=-1) >= (value != mask).sum(dim=-1) + 1).all()  # at least one more
        assert revealed[:, 0, 0].all()
        assert not revealed[:, 0, 1].any()
        # A token is as sure as the value that was drawn for it.
        assert revealed[:, 0, 2].float().mean() == pytest.approx(0.95, abs=0.04)
        assert (draws[:, 0, 2][revealed[:, 0, 2]] == 0).all()
        last = process.reverse_step(value, prediction, torch.tensor(0.9), torch.tensor(0.0), generator())
        assert last.max() < mask

    def test_with_a_threshold_the_denoiser_is_told_the_fraction_of_masks(self):
        value = torch.tensor([[2, 2, 0, 1], [0, 1, 1, 0]])
        levels = MaskedProcess(vocabulary_size=2, confidence_threshold=0.9).told_level(value, torch.tensor(0.7))
        assert levels.tolist() == [0.5, 0.0]
        assert MaskedProcess(vocabulary_size=2).told_level(value, torch.tensor(0.5)).tolist() == [0.5, 0.5]

    @pytest.mark.parametrize("confidence_threshold", [None, 0.8])
    @pytest.mark.parametrize("num_steps", [1, 10, 100])
    def test_a_fully_masked_start_ends_without_a_mask(self, num_steps, confidence_threshold):
        process = MaskedProcess(4, confidence_threshold)
        levels = process.levels(num_steps)
        value = process.prior((64, 30), torch.device("cpu"))
        for level, next_level in pairwise(levels):
            value = process.reverse_step(value, torch.randn(64, 30, 4), level, next_level)
        assert value.max() < process.mask_id

    def test_levels_are_the_papers_cosine_grid(self):
        levels = MaskedProcess(4).levels(N)
        for i in (0, 1, 50, 99):
            assert levels[i] == pytest.approx(math.cos(math.pi * i / (2 * N)), abs=1e-6)
        assert levels[N] == 0

    def test_training_levels_have_low_discrepancy(self):
        """One level in each of B equal parts of (0, 1], in random order."""
        torch.manual_seed(0)
        levels = MaskedProcess(4).sample_level(64, torch.device("cpu"))
        parts = (levels.clamp(max=1 - 1e-6) * 64).long()
        assert len(parts.unique()) >= 63  # MIN_LEVEL may push one over a boundary
        assert not torch.equal(levels, levels.sort().values)
        assert levels.min() > 0
