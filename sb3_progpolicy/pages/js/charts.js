// Small line charts of an episode, with the present step marked; a click goes to a step.

class ChartsView {
  // timeline: where the first chart goes, right below the episode; container: where all others go
  constructor(timeline, container, program, seek) {
    Object.assign(this, { timeline, container, program, seek });
  }

  // Draw the charts of an episode.
  build(frames) {
    const steps = frames.filter((frame) => !frame.final);
    this.length = Math.max(1, steps.length - 1);
    this.charts = [];
    const [first, ...others] = steps.length < 2 ? [make("p", { class: "note" }, "")] : this.all(steps);
    this.timeline.replaceChildren(first);
    this.container.replaceChildren(...others);
    this.container.parentElement.hidden = others.length === 0;
  }

  all(steps) {
    const { conditions, outputNames, action } = this.program;
    const names = outputNames.map(pretty);
    const outputs = names.map((_, i) => steps.map((step) => step.outputs[step.branch][i]));
    const scores = this.lines(action.kind === "box" ? "Outputs, before clipping" : "Scores", names, outputs);
    const actions = () => this.roll("Actions", names, steps.map((step) => chosenOutputs(action, step.action)));
    const charts = [action.kind === "box" ? scores : actions()];
    if (conditions.length) {
      const rows = [...conditions.map((_, index) => `if B${index + 1}`), "else"];
      charts.push(this.roll("Active branch", rows, steps.map((step) => [step.branch])));
    }
    conditions.forEach(({ cell, readout }, index) => {
      const [name, values] = [`B${index + 1}`, steps.map((step) => step.conditionValues[index])];
      charts.push(this.lines(`Condition ${name}`, [name], [values]));
      if (cell === "affine" || cell === "min") return;
      const units = readout.map((_, unit) => steps.map((step) => step.memory[index][unit]));
      charts.push(this.lines(`Memory of ${name}`, units.map((_, unit) => `h${unit + 1}`), units));
    });
    if (action.kind !== "box") charts.push(scores);
    if (steps.some(({ reward }) => reward !== 0)) {
      let total = 0;
      charts.push(this.lines("Return so far", ["return"], [steps.map(({ reward }) => (total += reward))]));
    }
    return charts;
  }

  lines(title, names, series) {
    const values = series.flat();
    let [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [0, 0]);
    if (high - low < 1e-9) [low, high] = [low - 1, high + 1];
    const y = (value) => 5 + (90 * (high - value)) / (high - low);
    const paths = series.map((line, i) => {
      const points = line.map((value, t) => `${t} ${y(value).toFixed(2)}`);
      return draw("polyline", { points: points.join(" "), class: `series s${i % 8}` });
    });
    const rule = draw("line", { x1: 0, x2: this.length, y1: y(0), y2: y(0), class: "zero" });
    const scale = make("div", { class: "scale" }, make("span", {}, brief(high)), make("span", {}, brief(low)));
    const named = names.length > 1 && names.length <= 16 ? names : [];
    const legend = named.map((name, i) => make("li", { class: `s${i % 8}` }, name));
    return this.frame(title, [rule, ...paths], scale, legend);
  }

  // Which of some rows is on at each step.
  roll(title, rows, on) {
    const height = 100 / rows.length;
    const marks = on.flatMap((indices, t) =>
      indices.map((row) => {
        const size = { width: 1, height: 0.7 * height };
        return draw("rect", { x: t - 0.5, y: (row + 0.15) * height, ...size, class: "on" });
      })
    );
    const labels = make("div", { class: "scale rows" }, rows.map((name) => make("span", {}, name)));
    const chart = this.frame(title, marks, labels, [], Math.min(12, Math.max(2.6, rows.length * 1.15)));
    chart.classList.add("roll");
    return chart;
  }

  frame(title, parts, scale, legend, height = 5.5) {
    const cursor = draw("line", { y1: 0, y2: 100, class: "cursor" });
    const view = { viewBox: `-0.5 0 ${this.length + 1} 100`, preserveAspectRatio: "none", "aria-hidden": "true" };
    const svg = draw("svg", { ...view, style: `height: ${height}rem` }, parts, cursor);
    svg.addEventListener("click", (event) => {
      const box = svg.getBoundingClientRect();
      this.seek(Math.round(((event.clientX - box.left) / box.width) * (this.length + 1) - 0.5));
    });
    this.charts.push(cursor);
    return make(
      "figure",
      { class: "chart" },
      make("figcaption", {}, title),
      make("div", { class: "plot" }, scale, svg),
      legend.length ? make("ul", { class: "legend" }, legend) : null
    );
  }

  // Mark a step.
  update(t) {
    for (const cursor of this.charts) {
      cursor.setAttribute("x1", Math.min(t, this.length));
      cursor.setAttribute("x2", Math.min(t, this.length));
    }
  }
}
