// Why the program decides as it does: every condition's and output's value, and what each term adds to one of them.

const FEW_REASONS = 7;

class ReasonsView {
  constructor(container, policy) {
    Object.assign(this, { container, policy, picked: null, all: false });
  }

  // ending: the sentence to show after the last step
  update(frame, ending) {
    Object.assign(this, { frame, ending });
    if (frame.final) {
      const look = frame.success ? "verdict-line reached" : "verdict-line";
      this.container.replaceChildren(make("p", { class: look }, ending));
      return;
    }
    this.container.replaceChildren(this.sentence(), ...this.tests(), this.scores(), ...this.terms());
  }

  sentence() {
    const { program } = this.policy;
    const { kind, sizes } = program.action;
    const outputs = this.frame.outputs[this.frame.branch];
    const words = [make("strong", {}, actionWords(program, this.frame.action))];
    if (kind === "discrete" && sizes[0] > 1) {
      const [best, second] = outputs.map((value, i) => [value, i]).sort((a, b) => b[0] - a[0]);
      words.push(make("span", {}, `${show(best[0] - second[0])} ahead of ${pretty(program.outputNames[second[1]])}`));
    } else if (kind === "box") {
      words.push(make("span", {}, outputs.length === 1 ? "the action" : "the action, number by number"));
    }
    return make("p", { class: "decision" }, words);
  }

  focus() {
    const outputs = this.frame.outputs[this.frame.branch];
    if (this.picked !== null) return this.picked;
    const [chosen] = chosenOutputs(this.policy.program.action, this.frame.action);
    if (chosen !== undefined) return chosen;
    return outputs.reduce((best, value, i) => (Math.abs(value) > Math.abs(outputs[best]) ? i : best), 0);
  }

  // Show what adds up to an output, by its index, or to a condition, by a name such as "B1".
  pick(thing) {
    this.picked = this.picked === thing ? null : thing;
    this.update(this.frame, this.ending);
    this.container.querySelector(`[data-thing="${thing}"]`).focus();
  }

  // The values of the conditions; the first that is not below 0 decides.
  tests() {
    const { conditionValues, branch } = this.frame;
    if (conditionValues.length === 0) return [];
    const widest = Math.max(...conditionValues.map(Math.abs), 1e-9);
    const rows = conditionValues.map((value, i) => {
      const verdict = i < branch ? "no" : i === branch ? "yes: decides" : null;
      return this.choice(`B${i + 1}`, `B${i + 1} \u2265 0`, verdict, value, widest, i === branch);
    });
    return [make("div", { class: "tests", role: "group", "aria-label": "Values of all conditions" }, rows)];
  }

  scores() {
    const { action, outputNames } = this.policy.program;
    const outputs = this.frame.outputs[this.frame.branch];
    const chosen = chosenOutputs(action, this.frame.action);
    const widest = Math.max(...outputs.map(Math.abs), 1e-9);
    const rows = outputs.map((value, i) => {
      const [low, high] = action.kind === "box" ? [action.low[i], action.high[i]] : [-Infinity, Infinity];
      const clipped = value < low ? `clipped to ${brief(low)}` : value > high ? `clipped to ${brief(high)}` : null;
      return this.choice(i, pretty(outputNames[i]), clipped, value, widest, chosen.includes(i));
    });
    return make("div", { class: "scores", role: "group", "aria-label": "Scores of all outputs" }, rows);
  }

  choice(thing, name, note, value, widest, chosen) {
    const label = `${name}: ${show(value)}${note ? `, ${note}` : ""}`;
    return make(
      "button",
      {
        type: "button", class: chosen ? "score chosen" : "score", "data-thing": thing, "aria-label": label,
        "aria-pressed": String(thing === this.focus()), onclick: () => this.pick(thing),
      },
      make("span", { class: "name" }, name, note ? make("small", {}, note) : null),
      bar(value, widest),
      make("span", { class: "number" }, show(value))
    );
  }

  // The sum that is shown: a name, a constant, and weights with what they are multiplied by.
  sum() {
    const { program } = this.policy;
    const { inputs, branch, outputs, memory, conditionValues } = this.frame;
    const thing = this.focus();
    if (typeof thing === "number") {
      const { weights, bias } = program.controllers[branch];
      const sum = { total: outputs[branch][thing], constant: bias[thing], weights: weights[thing] };
      return { ...sum, name: program.outputNames[thing], values: inputs, names: program.inputNames };
    }
    const index = Number(thing.slice(1)) - 1;
    const { cell, readout, readoutBias, weightIh, biasIh } = program.conditions[index];
    if (cell === "min") {
      const totals = weightIh.map((row, i) => row.reduce((sum, weight, j) => sum + weight * inputs[j], biasIh[i]));
      const least = totals.findIndex((total) => Object.is(total, Math.min(...totals))); // this sum is B
      const name = totals.length > 1 ? `${thing}, its least sum (${least + 1} of ${totals.length})` : thing;
      const sum = { name, total: totals[least], constant: biasIh[least], weights: weightIh[least] };
      return { ...sum, values: inputs, names: program.inputNames };
    }
    const sum = { name: thing, total: conditionValues[index], constant: readoutBias, weights: readout };
    if (cell === "affine") return { ...sum, values: inputs, names: program.inputNames };
    return { ...sum, values: memory[index], names: readout.map((_, unit) => `memory h${unit + 1}`) };
  }

  // Every term of one sum, the largest first; together with the constant they are its value.
  terms() {
    const { name: subject, total, constant, weights, values, names } = this.sum();
    const terms = weights.map((weight, j) => {
      const product = `${brief(weight)} \u00d7 ${brief(values[j])}`;
      return { value: weight * values[j], name: pretty(names[j]), product };
    });
    const silent = terms.filter(({ value }, j) => value === 0 && weights[j] !== 0).length;
    const heard = terms.filter(({ value }) => value !== 0);
    if (constant !== 0) heard.push({ value: constant, name: "constant", product: "" });
    heard.sort((a, b) => Math.abs(b.value) - Math.abs(a.value));
    const shown = this.all || heard.length <= FEW_REASONS + 1 ? heard : heard.slice(0, FEW_REASONS);
    const rest = heard.slice(shown.length);
    const widest = Math.max(...heard.map(({ value }) => Math.abs(value)), 1e-9);
    const rows = shown.map(({ value, name, product }) => this.row(name, product, value, widest));
    if (rest.length) {
      const sum = rest.reduce((sum, { value }) => sum + value, 0);
      rows.push(this.row(counted(rest.length, "further term"), "", sum, widest, "rest"));
    }
    const toggle = () => {
      this.all = !this.all;
      this.update(this.frame, this.ending);
      this.container.querySelector("button.quiet")?.focus();
    };
    const quiet = { type: "button", class: "quiet", onclick: toggle };
    const parts = [
      make("h3", {}, "What adds up to ", make("em", {}, pretty(subject))),
      make(
        "div",
        { class: "terms", role: "list", "aria-label": "Terms, the largest first" },
        rows,
        this.row("sum", "", total, null, "total")
      ),
    ];
    if (heard.length > FEW_REASONS + 1) {
      parts.push(make("button", quiet, this.all ? "Show fewer terms" : `Show all ${heard.length} terms`));
    }
    if (silent) {
      const more = `${counted(silent, "more term")} ${silent === 1 ? "adds" : "add"}`;
      parts.push(make("p", { class: "note" }, `${more} nothing now, since the input is 0.`));
    }
    return parts;
  }

  row(name, product, value, widest, look = "") {
    return make(
      "div",
      { class: `reason ${look}`, role: "listitem" },
      make("span", { class: "name" }, name, product ? make("small", {}, product) : null),
      widest === null ? make("span", { class: "bar blank" }) : bar(value, widest),
      make("span", { class: "number" }, widest === null ? show(value) : signed(value))
    );
  }
}

// A bar from the middle: to the right for what raises, to the left for what lowers.
function bar(value, widest) {
  const share = (50 * Math.min(1, Math.abs(value) / widest)).toFixed(2);
  const style = `${value < 0 ? "right" : "left"}: 50%; width: ${share}%`;
  const inner = make("i", { class: value < 0 ? "lowers" : "raises", style });
  return make("span", { class: "bar", "aria-hidden": "true" }, inner);
}
