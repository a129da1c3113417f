// The verdict on a training, from the scores of its photos; the twin of gsplat_edu/evaluate/verdict.py, which says where
// the limits come from.

const [ALIKE, GOOD, FAIR] = [30, 25, 18]; // dB
const OVERFITTED = 5; // dB
const UNFIT = 24; // dB
const FEW_PHOTOS = 30;

const LOOKS = {
  Good: "new views look like the photos",
  Fair: "new views are soft",
  Poor: "new views are wrong in places",
};

// {grade, sentence}. test, train: mean PSNR of held-out and of training photos, dB; test is null if none was held out.
// photos: number of all photos. worst: name of the held-out photo with the lowest score, if there are several.
export function judged({ test, train, photos, worst = null }) {
  const kept = "Hold out every eighth photo in the next training.";
  if (test === null) {
    if (train < FAIR) return withReason("Poor", reasonOf({ test, train, photos }), worst);
    return {
      grade: "Unknown",
      sentence: `Unknown: no photo was held out, which new views could be compared with. ${kept}`,
    };
  }
  const good = train - test >= OVERFITTED ? ALIKE : GOOD;
  const grade = test < FAIR ? "Poor" : test >= good ? "Good" : "Fair";
  if (grade === "Good") return withReason(grade, null, worst);
  return withReason(grade, reasonOf({ test, train, photos }), worst);
}

function withReason(grade, reason, worst) {
  if (grade === "Good") return { grade, sentence: `Good: ${LOOKS.Good}. Look at it from all sides, and share it.` };
  const advice = reason ? reason[1] : `Compare ${worst ?? "the worst photo"} with its render.`;
  return { grade, sentence: `${grade}: ${LOOKS[grade]}${reason ? `, because ${reason[0]}` : ""}. ${advice}` };
}

// Why a scene is not better, and what to do: [clause, sentence]; null if nothing measured says so.
function reasonOf({ test, train, photos }) {
  const misfit = "the scene does not even fit the photos that it was trained on, whose poses may be wrong";
  if (train < UNFIT) return [misfit, "Train again with refined poses."];
  if (test === null || train - test < OVERFITTED) return null;
  const more = "Take more photos between the existing ones.";
  if (photos >= FEW_PHOTOS) return ["the scene has learned its photos, not what lies between them", more];
  return [photos === 1 ? "there is only 1 photo" : `there are only ${photos} photos`, more];
}
