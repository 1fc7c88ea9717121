"""Train one variant on one task, and record what its networks do at each evaluation, as JSON lines (about.md)."""

# mypy: ignore-errors
# ruff: noqa: E402, E741, I001
import argparse
import json
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn

th.set_num_threads(1)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import get_flattened_obs_dim

from sb3_aarl import SACAux
from sb3_aarl.encoders import SimbaEncoder
from sb3_aarl.envs import make_dmc_env

SEED0 = 10_000
RANDOM = 5000


def make(task, seed):
    if "-v" in task:
        import warnings

        warnings.filterwarnings("ignore")
        return gym.make(task), 1
    return make_dmc_env(task, action_repeat=2, seed=seed), 2


class ConcatSimba(SimbaEncoder):
    """Latent state and normalised observation side by side."""

    def __init__(self, space, features_dim=64, **kw):
        super().__init__(space, features_dim, **kw)
        n = get_flattened_obs_dim(space)
        self._features_dim = features_dim + n
        self.trunk_dim = features_dim + n

    def trunk(self, observations):
        x = self.normalization(observations.reshape(observations.shape[0], -1)).clamp(-10, 10)
        return th.cat([self.layers(x), x], dim=1)


from sb3_aarl.policies import SACAuxPolicy


class BNPolicy(SACAuxPolicy):
    """Q heads with batch norm before every linear layer (CrossQ)."""

    def make_critic(self, *a, **k):
        critic = super().make_critic(*a, **k)
        for i, q in enumerate(critic.q_networks):
            layers = []
            for layer in q:
                if isinstance(layer, nn.Linear):
                    layers.append(nn.BatchNorm1d(layer.in_features, eps=1e-3, momentum=0.01))
                layers.append(layer)
            critic.q_networks[i] = nn.Sequential(*layers).to(self.device)
            setattr(critic, f"qf{i}", critic.q_networks[i])
        return critic


class BNAux(SACAux):
    target = False

    def _sample(self, batch_size):
        self._batch, windows = super()._sample(batch_size)
        return self._batch, windows

    def _bn(self, mode):
        for q in self.critic.q_networks:
            q.train(mode)

    @th.enable_grad()
    def _target_q(self, next_observations, rewards, dones, discounts, ent_coef):
        with th.no_grad():
            next_actions, next_log_prob = self._act(next_observations)
            self._bn(False)
        z = self.critic.encode(self._batch.observations)
        with th.no_grad():
            zn = self.critic.encode(next_observations)
        self._bn(True)
        q = th.cat(self.critic.q_values(th.cat([z, zn]), th.cat([self._batch.actions, next_actions])), 1)
        self._bn(False)
        n = len(z)
        self._q = q[:n]
        if self.target:
            with th.no_grad():
                zt, znt = self.critic_target.encode(self._batch.observations), self.critic_target.encode(next_observations)
                for net in self.critic_target.q_networks:
                    net.train(True)
                qn = th.cat(self.critic_target.q_values(th.cat([zt, znt]), th.cat([self._batch.actions, next_actions])), 1)[n:]
                for net in self.critic_target.q_networks:
                    net.train(False)
        else:
            qn = q[n:].detach()
        nq = qn.min(1, keepdim=True)[0]
        return (rewards + (1 - dones) * discounts * (nq - ent_coef * next_log_prob)).detach()

    def _critic_loss(self, trunk, actions, target_q):
        return 0.5 * ((self._q - target_q) ** 2).mean(0).sum()


class BNTAux(BNAux):
    target = True


LN = {"pi": "mlp", "qf": "layer_norm"}
LNB = "layer_norm"


def pk(**kw):
    return {"features_extractor_class": "simba", **kw}


B = {"ent_coef": "auto_0.01", "target_entropy": "half"}
V = {
    "base": {"ent_coef": "auto", "ent_coef_learning_rate": 6e-4},
    "base01": {},
    "none": {"ent_coef": "auto", "ent_coef_learning_rate": 6e-4, "aux_loss": None},
    "ln": {"ent_coef": "auto", "ent_coef_learning_rate": 6e-4, "policy_kwargs": pk(network=LN)},
    "lnB": dict(**B, policy_kwargs=pk(network=LN)),
    "lnBB": dict(**B, policy_kwargs=pk(network=LNB)),
    "lnB3": dict(**B, n_steps=3, policy_kwargs=pk(network=LN)),
    "lnB3s": dict(**B, n_steps=3, encoder_tau=0.005, policy_kwargs=pk(network=LN)),
    "lnB3_sep": dict(**B, n_steps=3, policy_kwargs=pk(network=LN, share_features_extractor=False)),
    "lnB_sep": dict(**B, policy_kwargs=pk(network=LN, share_features_extractor=False)),
    "lnBB_sep": dict(**B, policy_kwargs=pk(network=LNB, share_features_extractor=False)),
    "lnB3_none": dict(**B, n_steps=3, aux_loss=None, policy_kwargs=pk(network=LN)),
    "lnB_cat": dict(**B, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)),
    "lnB3_cat": dict(**B, n_steps=3, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)),
    "lnBB3_cat": dict(**B, n_steps=3, policy_kwargs=pk(network=LNB, features_extractor_class=ConcatSimba)),
    "lnB3_1q": dict(**B, n_steps=3, policy_kwargs=pk(network=LN, n_critics=1)),
    "lnB_lr1": dict(**B, learning_rate=1e-3, policy_kwargs=pk(network=LN)),
    "lnB3_lr1": dict(**B, learning_rate=1e-3, n_steps=3, policy_kwargs=pk(network=LN)),
    "lnB3_d1": dict(**B, n_steps=3, policy_delay=1, policy_kwargs=pk(network=LN)),
    "lnB3_utd2": dict(**B, n_steps=3, gradient_steps=2, policy_kwargs=pk(network=LN)),
    "bn3_cat": dict(
        **B,
        cls=BNAux,
        policy=BNPolicy,
        n_steps=3,
        learning_rate=1e-3,
        policy_delay=3,
        policy_kwargs=pk(features_extractor_class=ConcatSimba, optimizer_kwargs={"betas": (0.5, 0.999)}),
    ),
    "bn3_cat_sep": dict(
        **B,
        cls=BNAux,
        policy=BNPolicy,
        n_steps=3,
        learning_rate=1e-3,
        policy_delay=3,
        policy_kwargs=pk(
            features_extractor_class=ConcatSimba, share_features_extractor=False, optimizer_kwargs={"betas": (0.5, 0.999)}
        ),
    ),
    "bn3_cat_none": dict(
        **B,
        cls=BNAux,
        policy=BNPolicy,
        n_steps=3,
        aux_loss=None,
        learning_rate=1e-3,
        policy_delay=3,
        policy_kwargs=pk(features_extractor_class=ConcatSimba, optimizer_kwargs={"betas": (0.5, 0.999)}),
    ),
    "bn_cat": dict(
        **B,
        cls=BNAux,
        policy=BNPolicy,
        learning_rate=1e-3,
        policy_delay=3,
        policy_kwargs=pk(features_extractor_class=ConcatSimba, optimizer_kwargs={"betas": (0.5, 0.999)}),
    ),
    "bnt3_cat": dict(**B, cls=BNTAux, policy=BNPolicy, n_steps=3, policy_kwargs=pk(features_extractor_class=ConcatSimba)),
    "lnBB3_cat_lr1": dict(
        **B, n_steps=3, learning_rate=1e-3, policy_kwargs=pk(network=LNB, features_extractor_class=ConcatSimba)
    ),
    "lnB3_cat_sep": dict(
        **B, n_steps=3, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba, share_features_extractor=False)
    ),
    "lnB3_cat_s": dict(**B, n_steps=3, encoder_tau=0.005, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)),
    "lnB3_cat_none": dict(**B, n_steps=3, aux_loss=None, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)),
    "lnB3_cat_w512": dict(
        **B,
        n_steps=3,
        policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba, net_arch={"pi": [256, 256], "qf": [512, 512]}),
    ),
    "lnB3_cat_1q": dict(**B, n_steps=3, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba, n_critics=1)),
    "lnB_cat_lr1": dict(**B, learning_rate=1e-3, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)),
    "lnB3_cat_lr1": dict(
        **B, n_steps=3, learning_rate=1e-3, policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)
    ),
    "lnBB3_cat_sep": dict(
        **B, n_steps=3, policy_kwargs=pk(network=LNB, features_extractor_class=ConcatSimba, share_features_extractor=False)
    ),
    "lnB3_cat_aarl": dict(
        **B, n_steps=3, aux_loss="aarl-state", policy_kwargs=pk(network=LN, features_extractor_class=ConcatSimba)
    ),
    "crossq256": {"contrib": "CrossQ", "policy_kwargs": {"net_arch": {"pi": [256, 256], "qf": [256, 256]}}},
    "crossq512": {"contrib": "CrossQ", "policy_kwargs": {"net_arch": {"pi": [256, 256], "qf": [512, 512]}}},
    "tqc": {"contrib": "TQC"},
    "sac": {
        "aux_loss": None,
        "policy_delay": 1,
        "ent_coef": "auto",
        "policy_kwargs": {"features_extractor_class": "identity"},
    },
}


def build(variant, env, seed):
    kw = json.loads("{}")
    kw.update(V[variant])
    kw["policy_kwargs"] = dict(kw.get("policy_kwargs", {}))
    cls = kw.pop("cls", SACAux)
    if kw.get("target_entropy") == "half":
        kw["target_entropy"] = -0.5 * env.action_space.shape[0]
    kw.setdefault("learning_starts", RANDOM)
    if kw.get("contrib"):
        import sb3_contrib

        return getattr(sb3_contrib, kw.pop("contrib"))("MlpPolicy", env, seed=seed, device="cpu", buffer_size=200_000, **kw)
    return cls(kw.pop("policy", "MlpPolicy"), env, seed=seed, device="cpu", buffer_size=200_000, **kw)


def hidden_outputs(seq, x):
    outs = []
    for layer in seq:
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            outs.append(x)
    return outs


class Probe(BaseCallback):
    def __init__(self, task, every, episodes, out, seed, repeat):
        super().__init__()
        self.task, self.every, self.episodes, self.out, self.seed0, self.repeat = task, every, episodes, out, seed, repeat
        self.start = time.time()
        self.spent = 0.0

    def _on_step(self):
        if self.num_timesteps % self.every == 0 and self.num_timesteps >= self.every:
            t = time.time()
            rec = self.evaluate()
            self.spent += time.time() - t
            rec["seconds"] = time.time() - self.start
            rec["eval_seconds"] = self.spent
            with open(self.out, "a") as f:
                f.write(json.dumps(rec) + "\n")
        return True

    def evaluate(self):
        m = self.model
        pol = m.policy
        was = pol.training
        pol.set_training_mode(False)
        env, _ = make(self.task, SEED0 + self.seed0)
        gamma = m.gamma
        rets, lens, bias, qs = [], [], [], []
        for ep in range(self.episodes):
            obs, _ = env.reset(seed=SEED0 + self.seed0 * 100 + ep)
            R, O, A = [], [], []
            while True:
                a, _ = m.predict(obs, deterministic=True)
                O.append(obs)
                A.append(a)
                obs, r, term, trunc, _ = env.step(a)
                R.append(r)
                if term or trunc:
                    break
            rets.append(sum(R))
            lens.append(len(R))
            G, g = np.zeros(len(R)), 0.0
            for i in reversed(range(len(R))):
                g = R[i] + gamma * g
                G[i] = g
            use = len(R) if term else max(1, len(R) - 300)
            idx = np.linspace(0, use - 1, min(use, 50)).astype(int)
            if not isinstance(m, SACAux):
                bias.append(0)
                qs.append(0)
                continue
            with th.no_grad():
                o = th.as_tensor(np.array(O)[idx], dtype=th.float32)
                a = th.as_tensor(np.array([pol.scale_action(np.array(x)) for x in np.array(A)[idx]]), dtype=th.float32)
                q = th.cat(m.critic.q_values(m.critic.encode(o), a), 1).min(1)[0].numpy()
            bias.append(float((q - G[idx]).mean()))
            qs.append(float(q.mean()))
        rec = {
            "step": self.num_timesteps,
            "env_steps": self.num_timesteps * self.repeat,
            "ret": float(np.mean(rets)),
            "std": float(np.std(rets)),
            "length": float(np.mean(lens)),
            "q": float(np.mean(qs)),
            "q_bias": float(np.mean(bias)),
        }
        if m.replay_buffer.size() > 2000 and isinstance(m, SACAux):
            state, th_state = np.random.get_state(), th.get_rng_state()
            batch = m.replay_buffer.sample(1024)
            np.random.set_state(state)
            th.set_rng_state(th_state)
            with th.no_grad():
                z = m.critic.encode(batch.observations)
                zt = m.critic_target.encode(batch.observations)
                s = th.linalg.svdvals(z - z.mean(0))
                p = s / s.sum()
                rec.update(
                    norm=float(z.norm(dim=1).mean()),
                    rank=float(th.exp(-(p * (p + 1e-12).log()).sum())),
                    target_gap=float((z - zt).norm(dim=1).mean() / z.norm(dim=1).mean()),
                )
                a, lp = m.actor.action_log_prob(batch.observations)
                rec.update(entropy=float(-lp.mean()), sat=float((a.abs() > 0.97).float().mean()))
                x = th.cat([z, batch.actions], 1)
                hs = [h for q in m.critic.q_networks for h in hidden_outputs(q, x)]
                rec["dead_q"] = float(np.mean([float((h <= 0).all(0).float().mean()) for h in hs])) if hs else None
                fa = m.actor.extract_features(batch.observations, m.actor.features_extractor)
                ha = hidden_outputs(m.actor.latent_pi, fa)
                rec["dead_pi"] = float(np.mean([float((h <= 0).all(0).float().mean()) for h in ha])) if ha else None
                rec["w_q"] = float(sum(p.norm() ** 2 for q in m.critic.q_networks for p in q.parameters()) ** 0.5)
                rec["r_abs"] = float(batch.rewards.abs().mean())
        for k in ("ent_coef", "critic_loss", "aux_loss", "actor_loss"):
            v = m.logger.name_to_value.get(f"train/{k}")
            if v is not None:
                rec[k] = float(v)
        pol.set_training_mode(was)
        env.close()
        return rec


def main():
    p = argparse.ArgumentParser()
    p.add_argument("variant")
    p.add_argument("task")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--steps", type=int, default=100_000, help="environment steps")
    p.add_argument("--every", type=int, default=10_000)
    p.add_argument("--out", default="out")
    p.add_argument("--episodes", type=int, default=5)
    p.add_argument("--seconds", type=float, default=1e9)
    p.add_argument("--random", type=int, default=1000)
    a = p.parse_args()
    if a.seconds < 1e9:
        import threading
        import os

        threading.Timer(a.seconds, lambda: os._exit(0)).start()
    global RANDOM
    RANDOM = a.random
    env, repeat = make(a.task, a.seed)
    out = Path(a.out) / f"{a.variant}_{a.task.replace('/', '-')}_{a.seed}.jsonl"
    out.parent.mkdir(exist_ok=True, parents=True)
    out.unlink(missing_ok=True)
    m = build(a.variant, env, a.seed)
    print(m.policy, file=sys.stderr)
    cb = Probe(a.task, a.every // repeat, a.episodes, out, a.seed, repeat)
    m.learn(a.steps // repeat, callback=cb, log_interval=10**9)


if __name__ == "__main__":
    main()
