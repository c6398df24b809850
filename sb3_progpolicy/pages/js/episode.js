// Episodes as frames: what the program reads, decides and gets at each step.

// Run the program in a world until the goal or the cap. The rewards that it reads are of 32 bits, as in training.
//
// cap: steps after which an episode has failed
// recorded: actions that were taken in place of the program's own, if given; the episode is as long as they are
function simulate(policy, world, cap, recorded = null) {
  policy.reset();
  const frames = [];
  let before = { action: null, reward: 0, done: false };
  const goesOn = recorded
    ? () => frames.length < recorded.length
    : () => !world.isSolved() && frames.length < cap;
  while (goesOn()) {
    const frame = decide(policy, world.observe(), before);
    frame.state = snapshot(world.state);
    if (recorded) frame.action = recorded[frames.length];
    const { reward, done, legal } = world.step(frame.action);
    frames.push(Object.assign(frame, { reward, legal }));
    before = { action: frame.action, reward: Math.fround(reward), done };
  }
  frames.push({ state: snapshot(world.state), final: true, success: world.isSolved() });
  return frames;
}

// The frames of an episode whose observations are recorded.
function replay(policy, episode) {
  policy.reset();
  const [observations, actions, rewards] = ["observations", "actions", "rewards"].map((key) => unpack(episode[key]));
  const width = policy.program.nObservations;
  const wide = actions.length / rewards.length;
  const single = policy.program.action.kind === "discrete";
  const frames = [];
  let before = { action: null, reward: 0, done: false };
  for (let t = 0; t < rewards.length; t += 1) {
    const frame = decide(policy, observations.slice(t * width, (t + 1) * width), before);
    frame.action = single ? actions[t] : Array.from(actions.slice(t * wide, (t + 1) * wide));
    frames.push(Object.assign(frame, { reward: rewards[t], legal: true, index: t }));
    before = { action: frame.action, reward: rewards[t], done: false };
  }
  frames.push({ final: true, success: episode.success, index: rewards.length });
  return frames;
}

// The frames of inputs that a reader sets by hand: one decision after the other.
function answer(policy, observations) {
  policy.reset();
  const frames = [];
  let before = { action: null, reward: 0, done: false };
  for (const observation of observations) {
    const frame = decide(policy, observation, before);
    frames.push(Object.assign(frame, { reward: 0, legal: true }));
    before = { action: frame.action, reward: 0, done: false };
  }
  return frames;
}

function decide(policy, observation, before) {
  const step = policy.advance(observation, before.action, before.reward, before.done);
  return { ...step, chosen: step.action, observation: Array.from(observation), before };
}

function snapshot(state) {
  return JSON.parse(JSON.stringify(state));
}

// Numbers of 32 bits, written as base64.
function unpack(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

if (typeof module !== "undefined" && module.exports) module.exports = { simulate, replay, answer, unpack };
