// The program as a tree: conditions from top to bottom along a spine, and the controller that each leads to.

const FEW_TERMS = 4;
const CELLS = { rnn: "RNN", gru: "GRU", lstm: "LSTM", switch: "switch" };

const MIN_NUMBERS = 4; // of a table, not zero
const [MAX_CELLS, MAX_COLUMNS] = [120, 12];

// The weights of a grid as the function `a + b row + c column` that they are, in words, or as the rows of a table;
// null where they are neither, or zero.
function onGrid({ name, start, rows, columns }, weights) {
  const given = weights.slice(start, start + rows * columns);
  if (!given.every(Number.isInteger)) return null;
  const table = Array.from({ length: rows }, (_, row) => given.slice(row * columns, (row + 1) * columns));
  const [a, b, c] = [given[0], rows > 1 ? table[1][0] - given[0] : 0, columns > 1 ? table[0][1] - given[0] : 0];
  if (table.every((numbers, row) => numbers.every((number, column) => number === a + b * row + c * column))) {
    const parts = [[a, ""], [b, "row"], [c, "column"]].filter(([number]) => number !== 0);
    if (parts.length === 0) return null;
    const words = parts.map(([number, of], place) => {
      const size = Math.abs(number) === 1 && of ? of : `${Math.abs(number)}${of ? "\u00a0" : ""}${of}`;
      const sign = number < 0 ? MINUS : place ? "+" : "";
      return place ? ` ${sign} ${size}` : sign + size;
    });
    return { name, words: words.join("") };
  }
  const numbers = given.filter((number) => number !== 0).length;
  const small = rows * columns <= MAX_CELLS && columns <= MAX_COLUMNS;
  return numbers >= MIN_NUMBERS && small ? { name, table } : null;
}

// A sum without its grids, and these.
function apart(weights, grids) {
  const [left, found] = [weights.slice(), []];
  for (const grid of grids) {
    const shown = onGrid(grid, weights);
    if (shown === null) continue;
    found.push(shown);
    left.fill(0, grid.start, grid.start + grid.rows * grid.columns);
  }
  return { left, found };
}

function gridTerm({ name, words, table }) {
  const title = `summed over all cells ${name}[row,column]; rows and columns count from 0`;
  if (words) return make("span", { class: "term", title }, `${pretty(name)} \u00d7 (`, make("b", {}, words), ")");
  const rows = table.map((numbers) => make("tr", {}, numbers.map((number) => make("td", {}, brief(number)))));
  return make("table", { class: "weights", title }, make("caption", {}, `${pretty(name)} \u00d7`), rows);
}

// A sum as text, the largest terms first; what is zero is left out, and what comes after `most` only counted.
function formula(constant, weights, names, most, grids = []) {
  const { left: single, found } = apart(weights, grids);
  const terms = single.map((weight, index) => ({ weight, name: names[index] })).filter(({ weight }) => weight !== 0);
  terms.sort((a, b) => Math.abs(b.weight) - Math.abs(a.weight));
  const alone = terms.length === 0 && found.length === 0;
  const parts = constant !== 0 || alone ? [make("span", { class: "term" }, brief(constant))] : [];
  for (const grid of found) parts.push(...(parts.length ? ["+"] : []), gridTerm(grid));
  for (const { weight, name } of terms.slice(0, most)) {
    const [sign, space] = [weight < 0 ? MINUS : parts.length ? "+" : "", parts.length ? "\u00a0" : ""];
    const text = `${sign}${space}${brief(Math.abs(weight))}`;
    const size = make("b", { class: weight < 0 ? "lowers" : "raises" }, text);
    parts.push(make("span", { class: "term" }, size, "\u00a0", pretty(name)));
  }
  const left = terms.length - most;
  if (left > 0) parts.push(make("span", { class: "term rest" }, `+ ${counted(left, "more term")}`));
  return parts.flatMap((part) => [part, " "]);
}

// One switch that does not read itself, which is shown as what turns it on and off.
function isSwitch({ cell, readout, weightHh }) {
  return cell === "switch" && readout.length === 1 && weightHh.every((row) => row.every((weight) => weight === 0));
}

class ProgramView {
  constructor(container, program, importance, grids) {
    Object.assign(this, { container, program, importance, grids, all: false });
    this.build();
  }

  build() {
    const { conditions, controllers } = this.program;
    this.values = [];
    this.lines = [];
    this.branches = controllers.map((controller, index) =>
      make("li", { class: "branch" }, this.test(conditions, index), this.leaf(controller, index))
    );
    const look = conditions.length ? "spine" : "spine alone";
    const spine = make("ol", { class: look, "aria-label": "Program" }, this.branches);
    const sums = [...controllers.flatMap(({ weights }) => weights), ...conditions.map(({ readout }) => readout)];
    const shown = conditions.filter(({ cell }) => ["min", "switch"].includes(cell)).flatMap(({ weightIh }) => weightIh);
    const hides = [...sums, ...shown].some(
      (row) => apart(row, this.grids).left.filter((weight) => weight !== 0).length > FEW_TERMS
    );
    const toggle = () => {
      this.all = !this.all;
      this.build();
      if (this.frame) this.update(this.frame);
      this.container.querySelector("button").focus();
    };
    const label = this.all ? "Show fewer terms" : "Show all terms";
    const button = make("button", { type: "button", class: "quiet", onclick: toggle }, label);
    this.scroller = make("div", { class: "scroller" }, spine);
    this.container.replaceChildren(this.scroller, ...(hides ? [button] : []));
  }

  test(conditions, index) {
    if (conditions.length === 0) return make("p", { class: "test" }, make("code", {}, "always"));
    if (index === conditions.length) return make("p", { class: "test" }, make("code", {}, "else"));
    this.values[index] = make("output", { class: "verdict" });
    const name = `B${index + 1}`;
    return make(
      "div",
      { class: "test" },
      make("p", {}, make("code", {}, `${index ? "else if" : "if"} ${name} \u2265 0`), this.values[index]),
      make("div", { class: "sum" }, `${name} = `, this.condition(conditions[index])),
      this.listens(conditions[index], index)
    );
  }

  condition(condition) {
    const { cell, readoutBias, readout, weightIh, biasIh } = condition;
    if (cell === "min") {
      const sums = weightIh.map((row, i) => formula(biasIh[i], row, this.program.inputNames, this.most(), this.grids));
      return ["the least of", ...sums.map((sum) => make("div", { class: "sum" }, sum))];
    }
    if (isSwitch(condition)) return `${brief(readoutBias + readout[0])} while on, ${brief(readoutBias)} while off`;
    const units = readout.map((_, unit) => `h${unit + 1}`);
    if (cell !== "affine") return formula(readoutBias, readout, units, this.most());
    return formula(readoutBias, readout, this.program.inputNames, this.most(), this.grids);
  }

  // A switch alone: what turns it on and off. It is off at first.
  switches({ weightIh, biasIh, biasHh }) {
    const lines = ["on", "off"].map((name, i) => {
      const constant = biasIh[i] + biasHh[i];
      if (weightIh[i].every((weight) => weight === 0)) {
        return make("div", { class: "sum" }, `${name} ${constant >= 0 ? "always" : "never"}`);
      }
      const sum = formula(constant, weightIh[i], this.program.inputNames, this.most(), this.grids);
      return make("div", { class: "sum" }, `${name} when `, sum, "\u2265 0");
    });
    return make("div", {}, lines);
  }

  listens({ cell, readout }, index) {
    if (cell === "affine" || cell === "min") return null;
    const condition = this.program.conditions[index];
    if (isSwitch(condition)) return this.switches(condition);
    const sizes = this.importance[index].map((size, i) => [size, this.program.inputNames[i]]);
    const order = sizes.filter(([size]) => size > 0);
    const names = order.sort((a, b) => b[0] - a[0]).slice(0, 3).map(([, name]) => pretty(name));
    const memory = `Memory of ${counted(readout.length, `${CELLS[cell]} unit`)}`;
    return make("p", { class: "sum" }, `${memory}; listens most to ${names.join(", ") || "nothing"}.`);
  }

  leaf({ weights, bias }, index) {
    const { outputNames, inputNames } = this.program;
    this.lines[index] = weights.map((row, i) =>
      make(
        "div",
        { class: "line" },
        make("dt", {}, pretty(outputNames[i])),
        make("dd", {}, formula(bias[i], row, inputNames, this.most(), this.grids))
      )
    );
    return make("dl", { class: "leaf", "aria-label": `Controller ${index + 1}` }, this.lines[index]);
  }

  most() {
    return this.all ? Infinity : FEW_TERMS;
  }

  // Light the branch that is taken and the outputs that are chosen.
  update(frame) {
    this.frame = frame;
    this.branches.forEach((element, index) => {
      element.classList.toggle("active", !frame.final && index === frame.branch);
      element.classList.toggle("passed", !frame.final && index < frame.branch);
      if (index === frame.branch) element.setAttribute("aria-current", "true");
      else element.removeAttribute("aria-current");
      const chosen = frame.final || index !== frame.branch ? [] : chosenOutputs(this.program.action, frame.action);
      this.lines[index].forEach((line, i) => line.classList.toggle("chosen", chosen.includes(i)));
    });
    this.reveal(this.branches[frame.branch]);
    this.values.forEach((output, index) => {
      const value = frame.final ? null : frame.conditionValues[index];
      output.textContent = value === null ? "" : `${brief(value)} ${value >= 0 ? "yes" : "no"}`;
    });
  }

  // Scroll the tree, and never the page, to the active branch.
  reveal(branch) {
    if (!branch || this.scroller.scrollHeight <= this.scroller.clientHeight) return;
    const [outer, inner] = [this.scroller.getBoundingClientRect(), branch.getBoundingClientRect()];
    if (inner.top < outer.top || inner.bottom > outer.bottom) this.scroller.scrollTop += inner.top - outer.top - 8;
  }
}

// Which outputs an action stands for; none of a Box, where every output is a number of the action.
function chosenOutputs({ kind, sizes, start }, action) {
  if (kind === "discrete") return [action - start];
  if (kind === "multi_binary") return action.flatMap((on, i) => (on ? [i] : []));
  if (kind === "box") return [];
  let first = 0;
  return sizes.map((size, part) => {
    first += size;
    return first - size + action[part];
  });
}

// An action in words.
function actionWords(program, action) {
  if (program.action.kind === "box") return action.map((value) => show(value)).join(", ");
  const names = chosenOutputs(program.action, action).map((index) => pretty(program.outputNames[index]));
  return names.join(", ") || "all off";
}
