// Why the program decides as it does: every output's score, and what each term adds to one of them.

const FEW_REASONS = 7;

class ReasonsView {
  constructor(container, policy) {
    Object.assign(this, { container, policy, picked: null, all: false });
  }

  // ending: the sentence to show after the last step
  update(frame, ending) {
    Object.assign(this, { frame, ending });
    if (frame.final) {
      this.container.replaceChildren(make("p", { class: frame.success ? "verdict-line reached" : "verdict-line" }, ending));
      return;
    }
    this.container.replaceChildren(this.sentence(), this.scores(), ...this.terms());
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

  pick(index) {
    this.picked = this.picked === index ? null : index;
    this.update(this.frame, this.ending);
    this.container.querySelectorAll(".score")[index].focus();
  }

  scores() {
    const { program } = this.policy;
    const outputs = this.frame.outputs[this.frame.branch];
    const [chosen, focus] = [chosenOutputs(program.action, this.frame.action), this.focus()];
    const widest = Math.max(...outputs.map(Math.abs), 1e-9);
    const rows = outputs.map((value, i) => {
      const [low, high] = program.action.kind === "box" ? [program.action.low[i], program.action.high[i]] : [-Infinity, Infinity];
      const clipped = value < low ? `clipped to ${brief(low)}` : value > high ? `clipped to ${brief(high)}` : null;
      return make(
        "button",
        {
          type: "button",
          class: chosen.includes(i) ? "score chosen" : "score",
          "aria-pressed": String(i === focus),
          "aria-label": `${pretty(program.outputNames[i])}: ${show(value)}${clipped ? `, ${clipped}` : ""}`,
          onclick: () => this.pick(i),
        },
        make("span", { class: "name" }, pretty(program.outputNames[i]), clipped ? make("small", {}, clipped) : null),
        bar(value, widest),
        make("span", { class: "number" }, show(value))
      );
    });
    return make("div", { class: "scores", role: "group", "aria-label": "Scores of all outputs" }, rows);
  }

  // Every term of one output, the largest first; together with the constant they are the score.
  terms() {
    const { program } = this.policy;
    const [index, { branch, inputs }] = [this.focus(), this.frame];
    const { weights, bias } = program.controllers[branch];
    const added = this.policy.contributions(inputs, branch)[index];
    const terms = added.map((value, j) => ({ value, name: pretty(program.inputNames[j]), product: `${brief(weights[index][j])} \u00d7 ${brief(inputs[j])}` }));
    const silent = terms.filter(({ value }, j) => value === 0 && weights[index][j] !== 0).length;
    const heard = terms.filter(({ value }) => value !== 0);
    if (bias[index] !== 0) heard.push({ value: bias[index], name: "constant", product: "" });
    heard.sort((a, b) => Math.abs(b.value) - Math.abs(a.value));
    const shown = this.all || heard.length <= FEW_REASONS + 1 ? heard : heard.slice(0, FEW_REASONS);
    const rest = heard.slice(shown.length);
    const widest = Math.max(...heard.map(({ value }) => Math.abs(value)), 1e-9);
    const total = this.frame.outputs[branch][index];
    const rows = shown.map(({ value, name, product }) => this.row(name, product, value, widest));
    if (rest.length) {
      const sum = rest.reduce((sum, { value }) => sum + value, 0);
      rows.push(this.row(counted(rest.length, "smaller term"), "", sum, widest, "rest"));
    }
    const toggle = () => {
      this.all = !this.all;
      this.update(this.frame, this.ending);
      this.container.querySelector("button.quiet").focus();
    };
    const many = heard.length > FEW_REASONS + 1;
    return [
      make("h3", {}, "What adds up to ", make("em", {}, pretty(program.outputNames[index]))),
      make("div", { class: "terms", role: "list", "aria-label": "Terms, the largest first" }, rows,
        this.row("sum", "", total, null, "total")),
      many ? make("button", { type: "button", class: "quiet", onclick: toggle }, this.all ? "Show fewer terms" : `Show all ${heard.length} terms`) : null,
      silent ? make("p", { class: "note" }, `${counted(silent, "more term")} ${silent === 1 ? "adds" : "add"} nothing now, since the input is 0.`) : null,
    ].filter((part) => part !== null);
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
  const side = value < 0 ? `right: 50%` : `left: 50%`;
  return make("span", { class: "bar", "aria-hidden": "true" }, make("i", { class: value < 0 ? "lowers" : "raises", style: `${side}; width: ${share}%` }));
}
