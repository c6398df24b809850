// What the program reads: a table of all inputs now, and fields to set them by hand where there is no environment.

class InputsView {
  // rows: the body of a table; more: the button that shows all of them
  constructor(rows, more, names) {
    Object.assign(this, { rows, more, names, all: false });
    const few = matchMedia("(max-width: 700px)").matches ? 8 : 20;
    this.few = names.length <= few + 4 ? names.length : few;
    more.hidden = this.few === names.length;
    more.addEventListener("click", () => {
      this.all = !this.all;
      this.update(this.frame);
    });
  }

  update(frame) {
    this.frame = frame;
    const shown = this.all ? this.names : this.names.slice(0, this.few);
    this.rows.replaceChildren(...shown.map((name, i) => this.row(name, frame.final ? null : frame.inputs[i])));
    this.more.textContent = this.all ? "Show fewer" : `Show all ${this.names.length} inputs`;
  }

  row(name, value) {
    const cell = make("td", { class: value === 0 ? "number silent" : "number" }, value === null ? "" : brief(value));
    return make("tr", {}, make("th", { scope: "row" }, pretty(name)), cell);
  }
}

// A slider and a number for each observation.
class QuestionView {
  // set(index, value): what is called when a reader sets an input
  constructor(container, names, set) {
    Object.assign(this, { set });
    this.fields = names.map((name, index) => this.pair(pretty(name), index));
    const label = (i) => make("span", {}, pretty(names[i]));
    const rows = this.fields.map((pair, i) => make("div", { class: "input-row" }, label(i), pair));
    container.replaceChildren(make("div", { class: "input-rows" }, rows));
  }

  pair(name, index) {
    const bounds = { range: { min: -1, max: 1, step: 0.01 }, number: { step: "any" } };
    return Object.entries(bounds).map(([type, bound]) => {
      const read = (event) => {
        if (Number.isFinite(event.target.valueAsNumber)) this.set(index, event.target.valueAsNumber);
      };
      return make("input", { type, ...bound, "aria-label": name, "data-key": `${type}${index}`, oninput: read });
    });
  }

  // Show a frame's observation; the field that is being written in is left alone.
  update({ observation }) {
    this.fields.forEach((pair, i) => {
      for (const field of pair) if (field !== document.activeElement) field.value = observation[i];
    });
  }
}
