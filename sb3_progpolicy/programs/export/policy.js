// A program with its memory. Sums are taken in the order of X, so that they are those of the Python runner to the
// last bit; Math.tanh may differ from the C library's tanh in the last bit.
class ProgramPolicy {
  // program: plain data, by default the one that is written in this file.
  constructor(program = PROGRAM) {
    this.program = program;
    this.reset();
  }

  // Forget everything. Call it when the task changes, not when an episode ends.
  reset() {
    const zeros = (condition) => (condition.cell === "affine" ? [] : condition.readout.map(() => 0));
    this.hidden = this.program.conditions.map(zeros);
    this.carried = this.program.conditions.map(zeros); // an LSTM's c
  }

  // Choose an action: a number for "discrete", otherwise an array of numbers.
  //
  // observation: an array of numbers
  // previousAction: what the last call returned; null before the first
  // previousReward, previousDone: what the environment said after it
  act(observation, previousAction = null, previousReward = 0, previousDone = false) {
    return this.advance(observation, previousAction, previousReward, previousDone).action;
  }

  // Take the same step as act() and return all that led to the action:
  //
  // inputs: X; conditionValues: the B of each condition; memory: the hidden units of each condition
  // branch: index of the controller that acts; outputs: of every controller; action
  // contributions: for every controller, output and input, weight * input; with the bias they sum to the output
  explain(observation, previousAction = null, previousReward = 0, previousDone = false) {
    const step = this.advance(observation, previousAction, previousReward, previousDone);
    const contributions = this.program.controllers.map((_, index) => this.contributions(step.inputs, index));
    return { ...step, contributions };
  }

  // What every input adds to every output of one controller.
  contributions(inputs, controller) {
    return this.program.controllers[controller].weights.map((row) => row.map((weight, j) => weight * inputs[j]));
  }

  // One step, as explain() returns it but without the contributions.
  advance(observation, previousAction = null, previousReward = 0, previousDone = false) {
    const inputs = this.joinInputs(observation, previousAction, previousReward, previousDone);
    const conditionValues = this.program.conditions.map((condition, index) => this.test(condition, index, inputs));
    const outputs = this.program.controllers.map(({ weights, bias }) =>
      weights.map((row, i) => accumulate(bias[i], row, inputs))
    );
    const reached = conditionValues.findIndex((value) => value >= 0);
    const branch = reached < 0 ? conditionValues.length : reached;
    const memory = this.hidden.map((units) => units.slice());
    return { inputs, conditionValues, memory, branch, outputs, action: this.choose(outputs[branch]) };
  }

  // X: observation, previous action (one-hot where it is a choice), previous reward, previous done flag.
  joinInputs(observation, previousAction, previousReward, previousDone) {
    const { nObservations, interaction, action } = this.program;
    const inputs = Array.from(observation, Number);
    if (inputs.length !== nObservations) {
      throw new RangeError(`observation holds ${inputs.length} numbers; ${nObservations} are accepted`);
    }
    if (interaction) {
      // Rewards and actions are rounded as they are in training.
      inputs.push(...encodeAction(action, previousAction), Math.fround(previousReward), Number(previousDone));
    }
    if (!inputs.every(Number.isFinite)) {
      throw new RangeError("inputs hold a number that is infinite or not a number; finite numbers are accepted");
    }
    return inputs;
  }

  // Advance the memory of one condition and return its B.
  test(condition, index, inputs) {
    if (condition.cell === "affine") {
      return accumulate(condition.readoutBias, condition.readout, inputs);
    }
    if (condition.cell === "min") {
      return Math.min(...condition.weightIh.map((row, i) => accumulate(condition.biasIh[i], row, inputs)));
    }
    const size = condition.readout.length;
    const old = this.hidden[index];
    const separate = condition.cell === "gru" ? 2 * size : Infinity; // the GRU scales the recurrent part of n alone
    const gates = condition.weightIh.map((row, i) => {
      if (i >= separate) return accumulate(condition.biasIh[i], row, inputs);
      return accumulate(accumulate(condition.biasIh[i] + condition.biasHh[i], row, inputs), condition.weightHh[i], old);
    });
    const sum = (gate, unit) => gates[gate * size + unit];
    const units = old.map((h, u) => {
      if (condition.cell === "rnn") return Math.tanh(sum(0, u));
      if (condition.cell === "gru") {
        const recurrent = accumulate(condition.biasHh[2 * size + u], condition.weightHh[2 * size + u], old);
        const candidate = Math.tanh(sum(2, u) + sigmoid(sum(0, u)) * recurrent);
        return candidate + sigmoid(sum(1, u)) * (h - candidate);
      }
      if (condition.cell === "switch") return sum(0, u) >= 0 ? 1 : sum(1, u) >= 0 ? 0 : h;
      const carried = sigmoid(sum(1, u)) * this.carried[index][u] + sigmoid(sum(0, u)) * Math.tanh(sum(2, u));
      this.carried[index][u] = carried;
      return sigmoid(sum(3, u)) * Math.tanh(carried);
    });
    this.hidden[index] = units;
    return accumulate(condition.readoutBias, condition.readout, units);
  }

  // Turn the outputs of a controller into an action.
  choose(outputs) {
    const { kind, sizes, low, high, start } = this.program.action;
    if (kind === "discrete") return argmax(outputs) + start;
    if (kind === "multi_binary") return outputs.map((value) => (value > 0 ? 1 : 0));
    if (kind === "box") return outputs.map((value, i) => Math.fround(Math.min(Math.max(value, low[i]), high[i])));
    return split(outputs, sizes).map(argmax);
  }
}

// total + sum of weights[j] * values[j], added from left to right.
function accumulate(total, weights, values) {
  for (let j = 0; j < weights.length; j += 1) total += weights[j] * values[j];
  return total;
}

function sigmoid(x) {
  return 0.5 * Math.tanh(0.5 * x) + 0.5;
}

function argmax(values) {
  let best = 0;
  for (let i = 1; i < values.length; i += 1) if (values[i] > values[best]) best = i;
  return best;
}

function split(values, sizes) {
  let end = 0;
  return sizes.map((size) => values.slice(end, (end += size)));
}

// An action as numbers of X; zeros before the first.
function encodeAction({ kind, sizes, start }, action) {
  const width = sizes.reduce((total, size) => total + size, 0);
  if (action === null || action === undefined) return new Array(width).fill(0);
  const parts = kind === "discrete" ? [action] : Array.from(action);
  const expected = kind === "discrete" || kind === "multi_discrete" ? sizes.length : width;
  if (parts.length !== expected) {
    throw new RangeError(`previousAction holds ${parts.length} numbers; ${expected} are accepted`);
  }
  if (kind === "box" || kind === "multi_binary") return parts.map(Math.fround);
  return parts.flatMap((part, i) => {
    const index = Number(part) - start;
    if (!Number.isInteger(index) || index < 0 || index >= sizes[i]) {
      throw new RangeError(`previousAction=${part} is not accepted; ${start} to ${start + sizes[i] - 1} is`);
    }
    const encoded = new Array(sizes[i]).fill(0);
    encoded[index] = 1;
    return encoded;
  });
}

// Node's require() and import see the exports; a script of a page sees the names themselves.
if (typeof module !== "undefined" && module.exports) {
  module.exports = { ProgramPolicy, PROGRAM };
} else if (typeof globalThis !== "undefined") {
  globalThis.ProgramPolicy = ProgramPolicy;
}
