// Two pictures of one view over each other, with a slider between them.

import { useEffect, useRef, useState } from "preact/hooks";

export type Kind = "photo" | "before" | "after";
const WORDS: Record<Kind, string> = { photo: "Photograph", before: "Map before", after: "Map after" };

interface Props {
  image: number;
  name: string;
  count: number;
  pictures: Partial<Record<Kind, string>>;
  scores: { before: number | null; after: number | null };
  choose: (image: number) => void;
  step: (by: number) => void;
  fly: (() => void) | null;
  close: () => void;
}

export function Compare(props: Props) {
  const { image, pictures, scores } = props;
  const kinds = (["photo", "before", "after"] as const).filter((kind) => pictures[kind] !== undefined);
  const [left, setLeft] = useState<Kind>("before");
  const [right, setRight] = useState<Kind>("after");
  const [part, setPart] = useState(50);
  const section = useRef<HTMLElement>(null);
  useEffect(() => {
    section.current?.focus({ preventScroll: true });
    section.current?.scrollIntoView({ block: "nearest" });
  }, []);
  const pick = (wanted: Kind, fallback: Kind | undefined): Kind | null => (kinds.includes(wanted) ? wanted : (fallback ?? null));
  const [one, two] = [pick(left, kinds[0]), pick(right, kinds.at(-1))];
  return (
    <section class="compare" ref={section} tabIndex={-1} aria-label={`Image ${String(image)}`}>
      <header class="compare-head">
        <div class="stepper">
          <button type="button" class="icon-button" aria-label="Previous image" onClick={() => { props.step(-1); }}>‹</button>
          <label for="image-number">Image</label>
          <input id="image-number" type="number" min={0} max={props.count - 1} value={image} onChange={(event) => { props.choose(Number(event.currentTarget.value)); }} />
          <span class="quiet small">of {props.count}</span>
          <button type="button" class="icon-button" aria-label="Next image" onClick={() => { props.step(1); }}>›</button>
        </div>
        <span class="compare-scores">{scores.before !== null && scores.after !== null && <>{scores.before.toFixed(1)} → <strong>{scores.after.toFixed(1)} dB</strong></>}</span>
        {props.fly !== null && <button type="button" onClick={props.fly}>View from here</button>}
        <button type="button" class="icon-button" aria-label="Close the picture" onClick={props.close}>×</button>
      </header>
      {one === null || two === null ? <p class="quiet compare-none">There are no pictures of this image.</p> : (
        <div class="slider" style={{ "--part": `${String(part)}%` }}>
          <Picture url={pictures[two]} alt={`${WORDS[two]}, image ${String(image)}`} side="right" />
          <Picture url={pictures[one]} alt={`${WORDS[one]}, image ${String(image)}`} side="left" />
          <span class="slider-line" aria-hidden="true" />
          <input
            type="range" min={0} max={100} value={part} aria-label={`Between ${WORDS[one]} (left) and ${WORDS[two]} (right)`}
            aria-valuetext={`${String(part)} % ${WORDS[one]}`} onInput={(event) => { setPart(Number(event.currentTarget.value)); }}
          />
        </div>
      )}
      {one !== null && two !== null && (
        <div class="compare-sides">
          <Side label="Left" value={one} kinds={kinds} choose={setLeft} />
          <span class="quiet small compare-name">{props.name}</span>
          <Side label="Right" value={two} kinds={kinds} choose={setRight} />
        </div>
      )}
    </section>
  );
}

function Side({ label, value, kinds, choose }: { label: string; value: Kind; kinds: Kind[]; choose: (kind: Kind) => void }) {
  return (
    <select aria-label={`${label} side`} value={value} onChange={(event) => { choose(event.currentTarget.value as Kind); }}>
      {kinds.map((kind) => <option key={kind} value={kind}>{WORDS[kind]}</option>)}
    </select>
  );
}

/** Keeps the last picture until the next is there, so that nothing flickers. */
function Picture({ url, alt, side }: { url: string | undefined; alt: string; side: "left" | "right" }) {
  const [shown, setShown] = useState(url);
  useEffect(() => {
    if (url === undefined) return;
    let current = true;
    const image = new Image();
    image.src = url;
    const show = (): void => { if (current) setShown(url); };
    image.decode().then(show, show);
    return () => { current = false; };
  }, [url]);
  return shown === undefined ? null : <img class={`slider-${side}`} src={shown} alt={alt} draggable={false} />;
}
