// The page: one episode at one step, and everything that shows it.

class Page {
  constructor(data) {
    this.data = data;
    this.policy = new ProgramPolicy();
    this.program = this.policy.program;
    this.place = Object.fromEntries(
      ["tree", "variation", "board", "transport", "hint", "announcer", "reasons", "timeline", "charts", "inputs", "more-inputs"].map((id) => [id, document.getElementById(id)])
    );
    this.selected = null;
    this.allInputs = false;
    this.tree = new ProgramView(this.place.tree, this.program, data.importance);
    this.reasons = new ReasonsView(this.place.reasons, this.policy);
    this.charts = new ChartsView(this.place.timeline, this.place.charts, this.program, (t) => this.seek(t));
    this.makeTransport();
    if (data.episodes.length) this.makeVariations();
    else this.makeQuestion();
    const wish = new URLSearchParams(location.hash.slice(1));
    if (data.episodes.length) this.open(Math.min(Number(wish.get("episode") ?? this.firstEpisode()), data.episodes.length - 1));
    else this.ask([new Array(this.program.nObservations).fill(0)], 0);
    this.seek(Number(wish.get("step") || 0));
    document.addEventListener("keydown", (event) => this.press(event));
  }

  // The largest training variation: long enough to be worth a look.
  firstEpisode() {
    return Math.max(0, this.data.episodes.findLastIndex(({ kind }) => kind === "trained"));
  }

  open(index) {
    const episode = this.data.episodes[index];
    const world = WORLDS[this.data.world];
    Object.assign(this, { index, episode, edited: false, selected: null, scene: null });
    this.frames = world ? simulate(this.policy, new world(episode.start), episode.actions) : replay(this.policy, episode);
    if (episode.scene) this.scene = readScene(episode);
    this.begin(0);
  }

  // Let the program act from a state that the reader has made.
  edit(state) {
    Object.assign(this, { edited: true, selected: null });
    this.frames = simulate(this.policy, new WORLDS[this.data.world](state));
    this.begin(0);
    const { success } = this.frames[this.frames.length - 1];
    this.announce(`Your state. The program ${success ? "reaches the goal" : "does not reach the goal"} in ${counted(this.frames.length - 1, "step")}.`);
  }

  // Answer inputs that the reader has set.
  ask(observations, t) {
    this.observations = observations;
    this.frames = answer(this.policy, observations);
    this.begin(t);
  }

  begin(t) {
    this.stop();
    this.charts.build(this.frames);
    this.scrubber.max = this.frames.length - 1;
    this.showVariation();
    this.seek(t);
  }

  seek(t) {
    this.t = Math.max(0, Math.min(this.frames.length - 1, t));
    this.show();
  }

  step(by) {
    this.stop();
    this.selected = null;
    const asked = !this.data.episodes.length && by > 0 && this.t === this.frames.length - 1;
    if (asked) this.ask([...this.observations, this.observations[this.t]], this.t + 1);
    else this.seek(this.t + by);
    this.announce(this.status.textContent);
  }

  play() {
    if (this.timer) return this.stop();
    if (this.t === this.frames.length - 1) this.seek(0);
    const pause = Math.max(60, Math.min(700, 12000 / this.frames.length));
    this.timer = setInterval(() => {
      this.seek(this.t + 1);
      if (this.t === this.frames.length - 1) this.stop();
    }, pause);
    this.showPlaying();
    return undefined;
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.showPlaying();
  }

  press(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const pressed = event.target.closest("button, summary, [role=button]");
    if (event.target.matches("input") || (pressed && (event.key === " " || event.key === "Enter"))) return;
    const actions = {
      ArrowRight: () => this.step(1),
      ArrowLeft: () => this.step(-1),
      " ": () => this.play(),
      Home: () => this.step(-this.t),
      End: () => this.step(this.frames.length - 1 - this.t),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }

  announce(text) {
    this.place.announcer.textContent = text;
  }

  makeTransport() {
    const button = (label, sign, press) =>
      make("button", { type: "button", "aria-label": label, title: label, onclick: press }, icon(sign));
    const first = button("First step", "first", () => this.step(-this.t));
    const back = button("Step back", "back", () => this.step(-1));
    this.player = button("Play", "play", () => this.play());
    this.player.classList.add("player");
    const forward = button("Step forward", "forward", () => this.step(1));
    this.scrubber = make("input", { type: "range", min: 0, value: 0, "aria-label": "Step", oninput: () => (this.stop(), this.seek(Number(this.scrubber.value))) });
    this.status = make("p", { class: "status" });
    this.place.transport.append(make("div", { class: "controls" }, first, back, this.player, forward, this.scrubber), this.status);
  }

  makeVariations() {
    const last = this.data.episodes.length - 1;
    this.slider = make("input", { type: "range", min: 0, max: last, "aria-label": "Variation", oninput: () => this.open(Number(this.slider.value)) });
    const marks = this.data.episodes.map(({ kind }) => make("i", { class: kind }));
    this.label = make("p", { class: "variation-label" });
    this.place.variation.append(this.label, last ? make("div", { class: "slider" }, this.slider, make("div", { class: "marks", "aria-hidden": "true" }, marks)) : "");
    if (BOARDS[this.data.world]) {
      this.place.hint.textContent = BOARDS[this.data.world].hint;
      this.place.hint.hidden = false;
    }
  }

  makeQuestion() {
    this.player.hidden = true;
    this.place.hint.textContent = "Set the inputs: the program answers at once. A step forward keeps the answer and asks again; the program remembers what it has read.";
    this.place.hint.hidden = false;
  }

  showVariation() {
    if (!this.data.episodes.length) return;
    const words = this.edited ? "Your state" : variationWords(this.episode.variation, this.data.size);
    const kind = { trained: "training", validation: "validation, not trained on", unseen: "unseen in training" }[this.episode.kind];
    this.slider.value = this.index;
    this.slider.setAttribute("aria-valuetext", `${words}, ${kind}`);
    this.label.replaceChildren(
      make("strong", {}, words),
      this.edited
        ? make("button", { type: "button", class: "quiet", onclick: () => this.open(this.index) }, "Back to the recorded episode")
        : make("span", { class: `tag ${this.episode.kind}` }, kind)
    );
  }

  showPlaying() {
    const label = this.timer ? "Pause" : "Play";
    this.player.setAttribute("aria-label", label);
    this.player.title = label;
    this.player.replaceChildren(icon(label.toLowerCase()));
  }

  ending() {
    const steps = counted(this.frames.length - 1, "step");
    const best = this.edited || this.episode.optimal === null ? "" : ` The planner needs ${this.episode.optimal}.`;
    return this.frames[this.frames.length - 1].success ? `Goal reached in ${steps}.${best}` : `Goal not reached in ${steps}.${best}`;
  }

  show() {
    const frame = this.frames[this.t];
    this.scrubber.value = this.t;
    this.scrubber.setAttribute("aria-valuetext", `step ${this.t} of ${this.frames.length - 1}`);
    const reward = frame.final || !this.data.episodes.length ? "" : `, reward ${signed(frame.reward)}`;
    const illegal = frame.legal === false ? " (not possible: nothing moves)" : "";
    const does = frame.final ? this.ending() : `${actionWords(this.program, frame.action)}${reward}${illegal}`;
    this.status.textContent = `Step ${this.t}${this.data.episodes.length ? ` of ${this.frames.length - 1}` : ""}: ${does}`;
    this.drawBoard(frame);
    this.tree.update(frame);
    this.reasons.update(frame, frame.final ? this.ending() : "");
    this.charts.update(this.t);
    this.showInputs(frame);
  }

  drawBoard(frame) {
    const kept = document.activeElement && document.activeElement.getAttribute("data-key");
    if (this.scene) this.place.board.replaceChildren(drawScene(this.scene, frame.index));
    else if (BOARDS[this.data.world]) this.place.board.replaceChildren(BOARDS[this.data.world].draw(frame, this, this.frames.slice(0, this.t)));
    else if (!this.data.episodes.length) this.drawSliders(frame);
    if (kept) this.place.board.querySelector(`[data-key="${kept}"]`)?.focus();
  }

  // What a board calls when a thing is picked up or put back.
  select(thing) {
    this.stop();
    this.selected = thing;
    this.show();
  }

  drawSliders(frame) {
    const rows = frame.observation.map((value, i) => {
      const set = (input) => {
        const observations = this.observations.slice(0, this.t + 1);
        if (!Number.isFinite(input.valueAsNumber)) return;
        observations[this.t] = frame.observation.map((old, j) => (j === i ? input.valueAsNumber : old));
        this.ask(observations, this.t);
      };
      const name = pretty(this.program.inputNames[i]);
      const make_ = (kind, key) => make("input", { type: kind, min: kind === "range" ? -1 : null, max: kind === "range" ? 1 : null, step: kind === "range" ? 0.01 : "any", value, "aria-label": name, "data-key": `${key}${i}`, oninput: (event) => set(event.target) });
      return make("div", { class: "input-row" }, make("span", {}, name), make_("range", "range"), make_("number", "number"));
    });
    if (this.sliderFor === frame.observation.length && this.place.board.contains(document.activeElement)) {
      // Do not take the slider away that is being moved.
      frame.observation.forEach((value, i) => {
        for (const input of this.place.board.querySelectorAll(`[data-key$="e${i}"], [data-key="number${i}"]`)) {
          if (input !== document.activeElement) input.value = value;
        }
      });
      return;
    }
    this.sliderFor = frame.observation.length;
    this.place.board.replaceChildren(make("div", { class: "input-rows" }, rows));
  }

  showInputs(frame) {
    const inputs = frame.final ? null : frame.inputs;
    const [names, few] = [this.program.inputNames, matchMedia("(max-width: 700px)").matches ? 8 : 20];
    const shown = this.allInputs || names.length <= few + 4 ? names : names.slice(0, few);
    this.place.inputs.replaceChildren(
      ...shown.map((name, i) => make("tr", {}, make("th", { scope: "row" }, pretty(name)), make("td", { class: inputs && inputs[i] === 0 ? "number silent" : "number" }, inputs ? brief(inputs[i]) : "")))
    );
    const more = this.place["more-inputs"];
    more.hidden = names.length <= few + 4;
    more.textContent = this.allInputs ? "Show fewer" : `Show all ${names.length} inputs`;
    more.onclick = () => {
      this.allInputs = !this.allInputs;
      this.showInputs(frame);
    };
  }
}

// {n_discs: 3, layout: "comb"} as "3 discs, comb".
function variationWords(variation, size) {
  return Object.entries(variation)
    .map(([name, value]) => {
      if (name !== size) return String(value).split("\n").length > 1 ? `own ${name}` : String(value);
      const noun = name.replace(/^n_/, "").replace(/_/g, " ");
      return `${value} ${value === 1 ? noun.replace(/s$/, "") : noun}`;
    })
    .join(", ");
}

if (typeof document !== "undefined") window.page = new Page(JSON.parse(document.getElementById("data").textContent));
